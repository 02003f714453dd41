# The two commands of the README are `make run` and `make test`; `make help` lists the rest.
# Every target makes the virtual environment it needs, once, and again only after
# pyproject.toml or constraints.txt changed.

# The versions in constraints.txt were resolved for Python 3.11; later ones work as well.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
PY := $(VENV)/bin/python
# Isaac Lab pins what it shares with the other simulators: it has an environment of its own.
SIMULATORS := .venv-simulators
ISAAC := .venv-isaac
# RLlib pins Gymnasium to a version of its own.
RLLIB := .venv-rllib
PIP_INSTALL = $(@D)/bin/python -m pip install --quiet --disable-pip-version-check

.DEFAULT_GOAL := help
.PHONY: help run test test-ray environments test-simulators test-gpu test-pythons check format docs dist bench clean

help: ## this list
	@grep -E '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## (.*)/  make \1\t\2/' | expand -t 24

run: $(VENV)/installed ## collect 100,000 steps of HalfCheetah-v5 asynchronously
	$(VENV)/bin/rlightning-aio rollout configs/halfcheetah.yaml --steps 100000

# Most tests wait for processes of their own, so four at a time suit two cores. Who has none
# left takes over another's; until then each keeps to its files, which share what they prepare.
test: $(VENV)/installed-test ## the tests
	$(PY) -m pytest --numprocesses 4 --dist worksteal

# What is said of every place where envs may live, and what only Ray can be asked.
test-ray: $(VENV)/installed-ray ## the tests of `placement: ray`, on clusters of this machine
	$(PY) -m pytest -m ray tests/on_ray
	RLIGHTNING_AIO_ON_RAY=1 $(PY) -m pytest tests/group

# What `make test-simulators` installs; `make -j3 environments` installs the three at once.
environments: $(SIMULATORS)/installed $(ISAAC)/installed $(RLLIB)/installed

# Kernels that Isaac Lab compiled once are found again, by workers and tests alike.
test-simulators: export WARP_CACHE_PATH := $(CURDIR)/$(ISAAC)/warp-cache
test-simulators: export ISAAC_PYTHON := $(CURDIR)/$(ISAAC)/bin/python
test-simulators: environments ## the tests of every backend, on the real simulators (7 GB of packages)
	tests/simulators/install_debian.sh
	$(ISAAC)/bin/python -m pytest -m simulators -rs tests/envs/test_isaac.py
	$(SIMULATORS)/bin/python -m pytest --numprocesses 3 --dist worksteal -m simulators -rs tests/benchmarks tests/cli tests/envs tests/examples tests/vector tests/test_docs.py tests/test_wheel.py
	$(RLLIB)/bin/python -m pytest -m simulators -rs tests/vector/test_pages.py

# With -rs, each test that is skipped says what it lacks.
test-gpu: export WARP_CACHE_PATH := $(CURDIR)/$(ISAAC)/warp-cache
test-gpu: $(SIMULATORS)/installed $(ISAAC)/installed ## the tests of simulators on a CUDA GPU; skipped where there is none
	@for python in $(ISAAC)/bin/python $(SIMULATORS)/bin/python; do \
	    $$python -c 'import torch; print(torch.__version__, "CUDA", torch.cuda.is_available())'; done
	$(ISAAC)/bin/python -m pytest -m gpu -rs tests/envs/test_gpu.py
	$(SIMULATORS)/bin/python -m pytest -m gpu -rs tests/envs/test_gpu.py tests/envs/test_maniskill.py

# The wheel and the sdist, each as the only thing in an environment of each Python that is found.
# MuJoCo and the like come anew, so this takes some minutes.
test-pythons: $(VENV)/installed-release ## wheel and sdist in empty environments of Python 3.11, 3.12 and 3.13
	$(PY) -m pytest -m pythons -rs tests/test_wheel.py

check: $(VENV)/installed-check ## the static checks: ruff, pyright, import-linter
	$(VENV)/bin/ruff check
	$(VENV)/bin/ruff format --check
	PYRIGHT_PYTHON_IGNORE_WARNINGS=1 $(VENV)/bin/pyright --pythonpath $(PY)
	$(VENV)/bin/lint-imports

format: $(VENV)/installed-check ## lay the code out as `make check` wants it
	$(VENV)/bin/ruff check --fix
	$(VENV)/bin/ruff format

# Material tells whoever builds of its successor; the site doesn't need to know.
docs: export NO_MKDOCS_2_WARNING := 1
docs: $(VENV)/installed-docs ## the documentation site, into site/; warnings are errors
	$(VENV)/bin/mkdocs build

dist: $(VENV)/installed-release ## the wheel and the sdist, into dist/
	rm -rf dist
	$(PY) -m build

bench: $(VENV)/installed-bench $(VENV)/installed-pufferlib ## every benchmark, peers included (their packages are large)
	$(PY) benchmarks/run_all.py

clean: ## remove the virtual environments and every cache
	rm -rf $(VENV) $(SIMULATORS) $(ISAAC) $(RLLIB) build dist site .pytest_cache .ruff_cache .hypothesis .import_linter_cache
	find src tests benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +

%/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	    || { echo 'Python 3.11 or later is needed; name one with make PYTHON=...' >&2; exit 1; }
	@$(PYTHON) -m venv $* \
	    || { rm -rf $*; echo 'On Debian: apt install python3-venv' >&2; exit 1; }

# Each stamp is one set of extras. Only the stamp that is asked for is brought up to date,
# so `make run` never waits for the test tools.
$(VENV)/installed: extras :=
$(VENV)/installed-test: extras := [test]
$(VENV)/installed-check: extras := [test,check]
$(VENV)/installed-bench: extras := [bench]
$(VENV)/installed-docs: extras := [docs]
$(VENV)/installed-ray: extras := [test,ray]
$(VENV)/installed-release: extras := [test,release]
$(SIMULATORS)/installed: extras := [test,ale,envpool,examples,maniskill,notebook,pettingzoo,piper,sb3,torchrl]
STAMPS := $(VENV)/installed $(addprefix $(VENV)/installed-,test check docs bench ray release)
$(STAMPS): | $(PY)
$(SIMULATORS)/installed: | $(SIMULATORS)/bin/python
$(STAMPS) $(SIMULATORS)/installed: pyproject.toml constraints.txt
	$(PIP_INSTALL) --constraint constraints.txt --editable '.$(extras)'
	@touch $@

# It pins versions that nobody else does, of which its vector environments need none. Where it
# can't be installed, it is left out of the comparison.
$(VENV)/installed-pufferlib: constraints.txt | $(VENV)/installed-bench
	-$(PIP_INSTALL) --constraint constraints.txt --no-deps pufferlib-core
	@touch $@

$(RLLIB)/installed: pyproject.toml constraints.txt | $(RLLIB)/bin/python
	grep -v '^gymnasium==' constraints.txt > $(RLLIB)/constraints.txt
	$(PIP_INSTALL) --constraint $(RLLIB)/constraints.txt --editable '.[ray,test]' 'ray[rllib]' torch
	@touch $@

$(ISAAC)/installed: pyproject.toml tests/simulators/isaac.txt | $(ISAAC)/bin/python
	$(PIP_INSTALL) --requirement tests/simulators/isaac.txt
	$(PIP_INSTALL) --ignore-requires-python --no-deps isaaclab==3.0.0
	$(PIP_INSTALL) --editable '.[isaac,test]'
	@touch $@
