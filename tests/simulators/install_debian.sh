#!/usr/bin/env bash
# The Debian packages that the simulators' tests use beside Python's:
#   mesa-vulkan-drivers, libvulkan1   a software Vulkan, for ManiSkill's images. SAPIEN wants
#                                     Mesa 24 or later; Debian 12 has that in its backports.
#   libegl1                           EGL with Mesa's driver, for MuJoCo's images.
#   libgl1, libglib2.0-0, libx11-6    what OpenCV and SAPIEN are linked to.
# It installs what is missing, as root. Without apt or without root it says what would be
# missed and succeeds: the tests that need it are skipped then.
set -euo pipefail

libraries=(libegl1 libgl1 libglib2.0-0 libx11-6)
vulkan=(mesa-vulkan-drivers libvulkan1)
oldest_mesa=24
backports=/etc/apt/sources.list.d/backports-for-mesa.sources

version_of() { # version_of PACKAGE: what is installed, or nothing
    dpkg-query --show --showformat='${db:Status-Abbrev}${Version}' "$1" 2>/dev/null |
        sed -n 's/^ii //p'
}

is_recent() { # is_recent VERSION
    [ -n "$1" ] && dpkg --compare-versions "$1" ge "$oldest_mesa"
}

all_there() {
    local package
    for package in "${libraries[@]}" "${vulkan[@]}"; do
        [ -n "$(version_of "$package")" ] || return 1
    done
    is_recent "$(version_of mesa-vulkan-drivers)"
}

offered_mesa() {
    apt-cache policy mesa-vulkan-drivers | sed -n 's/^  Candidate: //p'
}

add_backports() { # add_backports RELEASE
    cat >"$backports" <<EOF
Types: deb
URIs: http://deb.debian.org/debian
Suites: $1-backports
Components: main
Signed-By: /usr/share/keyrings/debian-archive-keyring.gpg
EOF
}

if ! command -v apt-get >/dev/null || ! command -v dpkg-query >/dev/null; then
    echo "no apt here; ManiSkill's image tests need a Vulkan driver (Mesa $oldest_mesa or later)"
    exit 0
fi
if all_there; then
    exit 0
fi
if [ "$(id -u)" -ne 0 ]; then
    echo "not root: skipping the Debian packages ${libraries[*]} ${vulkan[*]}"
    exit 0
fi

export DEBIAN_FRONTEND=noninteractive
apt-get update -qq
from=()
if ! is_recent "$(offered_mesa)"; then
    release=$(. /etc/os-release && echo "$VERSION_CODENAME")
    [ -e "$backports" ] || add_backports "$release"
    apt-get update -qq
    from=(--target-release "$release-backports")
fi
apt-get install -qq --yes --no-install-recommends "${libraries[@]}"
apt-get install -qq --yes --no-install-recommends "${from[@]}" "${vulkan[@]}"
