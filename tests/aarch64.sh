#!/usr/bin/env bash
# Run the tests of rings, bell and kernel on aarch64: Debian's Python 3.11, emulated by qemu-user.
# All of it is fetched into build/aarch64, and nothing is installed. Usage: tests/aarch64.sh PYTHON
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
python=$(realpath -s "$1")
at=$PWD/build/aarch64
mkdir -p "$at"/{lists/partial,archives/partial,target,host,site}
touch "$at/status"

fetched() { # FOLDER PACKAGE...: unpack Debian's packages into a folder
    local folder=$1
    shift
    (cd "$at/archives" && rm -f ./*.deb && apt-get "${options[@]}" download "$@")
    for package in "$at"/archives/*.deb; do dpkg -x "$package" "$at/$folder"; done
}

if [ ! -e "$at/fetched" ]; then
    options=(--quiet)
    # The compiler's own dependencies on this machine are there wherever gcc is.
    fetched host qemu-user-static binutils-aarch64-linux-gnu gcc-12-aarch64-linux-gnu \
        cpp-12-aarch64-linux-gnu libc6-arm64-cross libc6-dev-arm64-cross \
        linux-libc-dev-arm64-cross libgcc-12-dev-arm64-cross
    options+=(-o APT::Architecture=arm64 -o APT::Architectures::=arm64
        -o "Dir::State=$at" -o "Dir::State::status=$at/status" -o "Dir::Cache=$at")
    apt-get "${options[@]}" update
    fetched target python3.11-minimal libpython3.11-minimal libpython3.11-stdlib libpython3.11 \
        libpython3.11-dev python3.11 libc6 libgcc-s1 libstdc++6 zlib1g libexpat1 libffi8 libssl3 \
        libbz2-1.0 liblzma5 libsqlite3-0 libuuid1 libdb5.3 libcrypt1
    platforms=()
    for version in 2_17 2_27 2_28; do platforms+=(--platform "manylinux_${version}_aarch64"); done
    grep -E '^(hypothesis|numpy|uvloop)==' constraints.txt | xargs "$python" -m pip download \
        --quiet --no-deps --only-binary :all: "${platforms[@]}" --platform manylinux2014_aarch64 \
        --python-version 3.11 --implementation cp --abi cp311 --abi abi3 --dest "$at/archives"
    for wheel in "$at"/archives/*.whl; do "$python" -m zipfile -e "$wheel" "$at/site"; done
    touch "$at/fetched"
fi

rm -rf "$at/src"
cp -r src "$at/src"
rm -f "$at"/src/rlightning_aio/protocol/*.so
LD_LIBRARY_PATH="$at/host/usr/lib/x86_64-linux-gnu" "$at/host/usr/bin/aarch64-linux-gnu-gcc-12" \
    -B"$at/host/usr/bin/aarch64-linux-gnu-" --sysroot="$at/host" \
    -isystem "$at/host/usr/aarch64-linux-gnu/include" -I"$at/target/usr/include/python3.11" \
    -I"$at/target/usr/include" -std=c11 -O2 -Wall -fPIC -shared -nostdlib \
    src/rlightning_aio/protocol/_kernel.c -o "$at/src/rlightning_aio/protocol/_kernel.abi3.so"
others=$("$python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
# The command line needs packages that are compiled; so the test of the variable is left out.
PYTHONPATH="$at/site:$at/src:$others" RLIGHTNING_AIO_IMPL=c \
    "$at/host/usr/bin/qemu-aarch64-static" -L "$at/target" "$at/target/usr/bin/python3.11" \
    -m pytest -p no:cacheprovider -p no:xdist -k "not variable" tests/protocol/test_rings.py \
    tests/protocol/test_bell.py tests/protocol/test_interleavings.py tests/protocol/test_kernel.py
