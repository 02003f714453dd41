# The two commands of the README are `make run` and `make test`; `make help` lists the rest.
# Every target makes the virtual environment it needs, once, and again only after pyproject.toml,
# constraints.txt, requirements/ or the compiled kernel changed. Without a C compiler, Python twins
# take the kernel's place (CC=/bin/false make test).

# The versions in constraints.txt were resolved for Python 3.11; later ones work as well.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
PY := $(VENV)/bin/python
# Isaac Lab pins what it shares with the other simulators: it has an environment of its own.
SIMULATORS := .venv-simulators
ISAAC := .venv-isaac
# RLlib pins Gymnasium to a version of its own.
RLLIB := .venv-rllib
# OpenEnv runs in processes of its own, and brings a hundred packages that nothing else here needs.
OPENENV := .venv-openenv
# MetaWorld and LeRobot's tasks need MuJoCo 3, and pygame in place of pygame-ce. openpi-client pins
# far more than the code that its tests use, so it comes alone.
ROBOTS := .venv-robots
# LeRobot needs Python 3.12, for which PyTorch comes with gigabytes of CUDA.
LEROBOT := .venv-lerobot
PYTHON_OF_LEROBOT ?= python3.12
# Trainers of language models pin far more than they use of each other.
TRAINERS := .venv-trainers
# What other projects' own tests need, and where `make test-peers PEERS=folder` finds their sources.
PEERS_VENV := .venv-peers
PEERS ?= peers
# What `pip install` brings without constraints.txt.
NEWEST := .venv-newest
PIP_INSTALL = $(@D)/bin/python -m pip install --quiet --disable-pip-version-check

.DEFAULT_GOAL := help
.PHONY: help run test simulate mutations test-programs test-newest test-sanitized test-aarch64 test-ray environments test-simulators test-gpu test-lerobot test-peers test-pythons test-site check prose format docs dist bench clean

help: ## this list
	@grep -E '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## (.*)/  make \1\t\2/' | expand -t 24

run: $(VENV)/installed ## four kinds of envs, by Gymnasium and here: how much faster on this machine
	@$(PY) benchmarks/demo.py

# Tests that run programs take half of the time, so they have a target of their own.
PROGRAMS := tests/attempts/test_killed.py tests/benchmarks tests/cli tests/examples tests/faults/test_shutdown.py \
    tests/legacy/test_scripts.py tests/peers tests/platforms tests/simulator/test_simulator.py tests/test_docs.py \
    tests/test_examples.py

# Most tests wait for processes that they start, so six at a time keep two cores busy. A process
# without tests takes some from another; until then it has whole files, whose tests share fixtures.
PYTEST = $(PY) -m pytest --numprocesses 6 --dist worksteal

test: $(VENV)/installed-test ## the tests of the library
	$(PYTEST) $(PROGRAMS:%=--ignore=%)

test-programs: $(VENV)/installed-test ## the tests of commands, benchmarks, examples, pages, random programs, ends of programs
	$(PYTEST) $(PROGRAMS)

# No stamp: what is newest changes every day.
test-newest: PY := $(NEWEST)/bin/python
test-newest: | $(NEWEST)/bin/python ## all of these tests, with the newest versions that pyproject.toml allows
	$(PY) -m pip install --quiet --disable-pip-version-check --upgrade --upgrade-strategy eager --editable . --requirement requirements/test.txt
	$(PY) -m pip list --disable-pip-version-check
	$(PYTEST)

# SEEDS=1000 programs from FIRST=0 on; SEED=7 replays one; REAL=1 uses real processes.
simulate: export PYTHONPATH := tests
simulate: $(VENV)/installed-test ## random programs in a simulated world, compared with a model: SEEDS=1000, SEED=n, REAL=1
	$(PY) -m simulator --seeds $(or $(SEEDS),1000) --first $(or $(FIRST),0) $(SEED:%=--seed %) $(REAL:1=--real)

# One defect: ONLY='late replies'. It takes an hour of one core.
mutations: export PYTHONPATH := tests
mutations: $(VENV)/installed-test ## defects that were fixed, put back one at a time: how many random programs find each
	$(PY) -m simulator.mutations --most $(or $(SEEDS),2000) $(if $(ONLY),--only '$(ONLY)')

# What is said of every place where envs may live, and what only Ray can be asked.
test-ray: $(VENV)/installed-ray ## the tests of `placement: ray`, on clusters of this machine
	$(PY) -m pytest -m ray tests/on_ray
	RLIGHTNING_AIO_ON_RAY=1 $(PY) -m pytest tests/group
	RLIGHTNING_AIO_ON_RAY=1 $(PY) -m pytest tests/attempts

# What `make test-simulators` installs; `make -j3 environments` installs three at once.
environments: $(SIMULATORS)/installed $(ISAAC)/installed $(RLLIB)/installed $(OPENENV)/installed $(ROBOTS)/installed $(TRAINERS)/installed

# Kernels that Isaac Lab compiled once are found again, by workers and tests alike.
test-simulators: export WARP_CACHE_PATH := $(CURDIR)/$(ISAAC)/warp-cache
test-simulators: export ISAAC_PYTHON := $(CURDIR)/$(ISAAC)/bin/python
test-simulators: export OPENENV_PYTHON := $(CURDIR)/$(OPENENV)/bin/python
test-simulators: environments ## the tests of every backend, on the real simulators (8 GB of packages)
	tests/simulators/install_debian.sh
	$(ISAAC)/bin/python -m pytest -m simulators -rs tests/envs/test_isaac.py
	$(SIMULATORS)/bin/python -m pytest --numprocesses 3 --dist worksteal -m simulators -rs tests/benchmarks tests/cli tests/envs tests/examples tests/policies tests/vector tests/test_docs.py
	$(RLLIB)/bin/python -m pytest -m simulators -rs tests/vector/test_pages.py
	$(TRAINERS)/bin/python -m pytest -m simulators -rs tests/trainers
	MUJOCO_GL=egl $(ROBOTS)/bin/python -m pytest -m simulators -rs tests/cli/test_simulators_page.py tests/envs/test_rendering.py tests/policies/test_real_servers.py

# With -rs, each test that is skipped says what it lacks.
test-gpu: export WARP_CACHE_PATH := $(CURDIR)/$(ISAAC)/warp-cache
test-gpu: $(SIMULATORS)/installed $(ISAAC)/installed ## the tests of simulators on a CUDA GPU; skipped where there is none
	@for python in $(ISAAC)/bin/python $(SIMULATORS)/bin/python; do \
	    $$python -c 'import torch; print(torch.__version__, "CUDA", torch.cuda.is_available())'; done
	$(ISAAC)/bin/python -m pytest -m gpu -rs tests/envs/test_gpu.py
	$(SIMULATORS)/bin/python -m pytest -m gpu -rs tests/envs/test_gpu.py tests/envs/test_maniskill.py

test-lerobot: export HF_HUB_OFFLINE := 1
test-lerobot: $(LEROBOT)/installed ## the tests of LeRobot (6 GB of packages, Python 3.12)
	$(LEROBOT)/bin/python -m pytest -m simulators -rs tests/vector/test_pages.py tests/vector/test_lerobot.py tests/test_export.py

# Their versions are to be those of constraints.txt; a project without a folder in PEERS is not run.
test-peers: $(PEERS_VENV)/installed ## Gymnasium's, SB3's and RLightning's own tests: make test-peers PEERS=folder
	$(PEERS_VENV)/bin/python tests/peers/run.py $(PEERS)

# Python's own allocator would hide what the sanitizer looks for. Interpreters leak at their end.
test-sanitized: export PYTHONPATH := build/sanitized
test-sanitized: export PYTHONMALLOC := malloc
test-sanitized: export ASAN_OPTIONS := detect_leaks=0
test-sanitized: $(VENV)/installed-test ## the compiled modules under AddressSanitizer and UBSan
	rm -rf build/sanitized && mkdir -p build && cp -r src build/sanitized
	for module in protocol/_kernel envs/mujoco/_advance; do \
	    $(CC) -std=c11 -g -O1 -Wall -Wextra -Wno-missing-field-initializers -Wno-cast-function-type -Werror \
	        -fsanitize=address,undefined -fno-sanitize-recover=all -fPIC -shared \
	        -I$$($(PY) -c 'import sysconfig; print(sysconfig.get_path("include"))') \
	        src/rlightning_aio/$$module.c -o build/sanitized/rlightning_aio/$$module.abi3.so || exit; \
	done
	LD_PRELOAD="$$($(CC) -print-file-name=libasan.so) $$($(CC) -print-file-name=libubsan.so)" \
	    $(PY) -m pytest tests/protocol tests/hosts/test_link.py \
	    tests/group/test_stepping.py tests/envs/test_mujoco_batch.py tests/envs/test_mujoco_judging.py

# The rings and the kernel on another processor's memory order: Debian's qemu runs Debian's Python.
test-aarch64: $(VENV)/installed-test ## the compiled kernel on aarch64, emulated (Debian; 200 MB)
	tests/aarch64.sh $(PY)

# The wheel and the sdist, each as the only thing in an environment of each Python that is found.
# MuJoCo and the like come anew, so this takes some minutes.
test-pythons: $(VENV)/installed-release ## wheel and sdist in empty environments of Python 3.11 to 3.14
	$(PY) -m pytest -m pythons -rs tests/test_wheel.py

check: $(VENV)/installed-check ## the static checks: ruff, pyright, import-linter, prose, names, sizes
	$(VENV)/bin/ruff check
	$(VENV)/bin/ruff format --check
	PYRIGHT_PYTHON_IGNORE_WARNINGS=1 $(VENV)/bin/pyright --pythonpath $(PY)
	$(VENV)/bin/lint-imports
	$(PY) tests/style/prose.py
	$(PY) tests/style/limits.py

prose: $(VENV)/installed-check ## the check of prose and names
	$(PY) tests/style/prose.py

format: $(VENV)/installed-check ## lay the code out as `make check` wants it
	$(VENV)/bin/ruff check --fix
	$(VENV)/bin/ruff format

# Material tells whoever builds of its successor; the site doesn't need to know.
docs: export NO_MKDOCS_2_WARNING := 1
docs: $(VENV)/installed-docs ## the documentation site, into site/; warnings are errors
	$(VENV)/bin/mkdocs build
	@echo 'Open $(CURDIR)/site/index.html in a browser.'

# It skips itself, and says so, where no Chromium is found.
test-site: export NO_MKDOCS_2_WARNING := 1
test-site: $(VENV)/installed-docs ## the site in a browser: search, clipped lines; screenshots in build/screenshots
	$(PY) -m pytest -m site -rs tests/test_site.py

dist: $(VENV)/installed-release ## the wheel and the sdist, into dist/
	rm -rf dist
	$(PY) -m build

bench: $(VENV)/installed-bench ## every benchmark that has a table, with every peer (their packages are large)
	$(PY) benchmarks/run_all.py

clean: ## remove the virtual environments and every cache
	rm -rf $(VENV) $(SIMULATORS) $(ISAAC) $(RLLIB) $(OPENENV) $(ROBOTS) $(TRAINERS) $(LEROBOT) $(PEERS_VENV) $(NEWEST) build dist site .pytest_cache .ruff_cache .hypothesis .import_linter_cache
	find src tests benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +

%/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	    || { echo 'Python 3.11 or later is needed; name one with make PYTHON=...' >&2; exit 1; }
	@$(PYTHON) -m venv $* \
	    || { rm -rf $*; echo 'On Debian: apt install python3-venv' >&2; exit 1; }

# Each stamp is one set of tools (requirements/) and extras. Only the stamp that is asked for is
# brought up to date, so `make run` never waits for the test tools.
$(VENV)/installed-test: tools := test
$(VENV)/installed-check: tools := test check
$(VENV)/installed-bench: tools := bench
$(VENV)/installed-docs: tools := test docs
$(VENV)/installed-ray: tools := test
$(VENV)/installed-ray: extras := [ray]
$(VENV)/installed-release: tools := test release
$(SIMULATORS)/installed: tools := test examples notebook
$(SIMULATORS)/installed: extras := [ale,maniskill,pettingzoo,piper,sb3,torchrl,websockets]
# Libraries whose pages it runs, too.
$(SIMULATORS)/installed: pages := envpool skrl tianshou skyrl-gym wandb
# What an installation is made from.
SOURCES := pyproject.toml setup.py constraints.txt $(wildcard requirements/*.txt src/rlightning_aio/*/*.c src/rlightning_aio/*/*/*.c)
STAMPS := $(VENV)/installed $(addprefix $(VENV)/installed-,test check docs bench ray release)
$(STAMPS): | $(PY)
$(SIMULATORS)/installed: | $(SIMULATORS)/bin/python
$(STAMPS) $(SIMULATORS)/installed: $(SOURCES)
	$(PIP_INSTALL) --constraint constraints.txt --editable '.$(extras)' $(tools:%=--requirement requirements/%.txt) $(pages)
	@touch $@

$(OPENENV)/installed: | $(OPENENV)/bin/python
	$(PIP_INSTALL) openenv==0.10.0
	@touch $@

$(ROBOTS)/installed: pyproject.toml constraints.txt | $(ROBOTS)/bin/python
	grep -vE '^(mujoco|numpy|opencv|pygame-ce)' constraints.txt > $(ROBOTS)/constraints.txt
	$(PIP_INSTALL) --constraint $(ROBOTS)/constraints.txt --editable . metaworld==3.0.0 'mujoco<3.17' 'gym-pusht<0.2' 'gym-aloha<0.2' \
	    hypothesis imageio-ffmpeg msgpack pytest pytest-asyncio pytest-timeout pytest-xdist websockets
	$(PIP_INSTALL) --no-deps openpi-client==0.1.2
	@touch $@

$(TRAINERS)/installed: pyproject.toml constraints.txt requirements/test.txt requirements/trainers.txt | $(TRAINERS)/bin/python
	$(PIP_INSTALL) --constraint constraints.txt --editable . --requirement requirements/test.txt --requirement requirements/trainers.txt
	$(PIP_INSTALL) --no-deps tinker-cookbook==0.6.1 verifiers==0.4.0 verl==0.9.1
	@touch $@

$(LEROBOT)/bin/python: PYTHON := $(PYTHON_OF_LEROBOT)
$(LEROBOT)/installed: pyproject.toml integrations/lerobot/pyproject.toml | $(LEROBOT)/bin/python
	$(PIP_INSTALL) --editable . 'lerobot[pusht,diffusion]==0.6.1' \
	    hypothesis pytest pytest-asyncio pytest-timeout pytest-xdist
	$(PIP_INSTALL) --no-deps ./integrations/lerobot
	@touch $@

$(RLLIB)/installed: pyproject.toml constraints.txt requirements/test.txt | $(RLLIB)/bin/python
	grep -v '^gymnasium==' constraints.txt > $(RLLIB)/constraints.txt
	$(PIP_INSTALL) --constraint $(RLLIB)/constraints.txt --editable '.[ray]' \
	    --requirement requirements/test.txt 'ray[rllib]' torch
	@touch $@

$(PEERS_VENV)/installed: pyproject.toml constraints.txt requirements/test.txt | $(PEERS_VENV)/bin/python
	$(PIP_INSTALL) --constraint constraints.txt --editable '.[ale,sb3]' \
	    --requirement requirements/test.txt --requirement requirements/examples.txt array-api-compat box2d hydra-core moviepy pandas
	@touch $@

$(ISAAC)/installed: pyproject.toml requirements/test.txt tests/simulators/isaac.txt | $(ISAAC)/bin/python
	$(PIP_INSTALL) --requirement tests/simulators/isaac.txt
	$(PIP_INSTALL) --ignore-requires-python --no-deps isaaclab==3.0.0
	$(PIP_INSTALL) --editable '.[isaac]' --requirement requirements/test.txt
	@touch $@
