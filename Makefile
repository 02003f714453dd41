# The two commands of the README are `make run` and `make test`; `make help` lists the rest.
# Every target makes the virtual environment it needs, once, and again only after
# pyproject.toml or constraints.txt changed.

# The versions in constraints.txt were resolved for Python 3.11; later ones work as well.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
PY := $(VENV)/bin/python
INSTALL = $(PY) -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable

.DEFAULT_GOAL := help
.PHONY: help run test check format bench clean

help: ## this list
	@grep -E '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## (.*)/  make \1\t\2/' | expand -t 24

run: $(VENV)/installed ## collect 100,000 steps of HalfCheetah-v5 asynchronously
	$(VENV)/bin/rlightning-aio rollout configs/halfcheetah.yaml --steps 100000

test: $(VENV)/installed-test ## the tests
	$(PY) -m pytest

check: $(VENV)/installed-check ## the static checks: ruff, pyright, import-linter
	$(VENV)/bin/ruff check
	$(VENV)/bin/ruff format --check
	PYRIGHT_PYTHON_IGNORE_WARNINGS=1 $(VENV)/bin/pyright --pythonpath $(PY)
	$(VENV)/bin/lint-imports

format: $(VENV)/installed-check ## lay the code out as `make check` wants it
	$(VENV)/bin/ruff check --fix
	$(VENV)/bin/ruff format

bench: $(VENV)/installed-bench ## every benchmark, peers included (their packages are large)
	$(PY) benchmarks/run_all.py

clean: ## remove the virtual environment and every cache
	rm -rf $(VENV) build dist .pytest_cache .ruff_cache .hypothesis .import_linter_cache
	find src tests benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +

$(PY):
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	    || { echo 'Python 3.11 or later is needed; name one with make PYTHON=...' >&2; exit 1; }
	@$(PYTHON) -m venv $(VENV) \
	    || { rm -rf $(VENV); echo 'On Debian: apt install python3-venv' >&2; exit 1; }

# Each stamp is one set of extras. Only the stamp that is asked for is brought up to date,
# so `make run` never waits for the test tools.
$(VENV)/installed: extras :=
$(VENV)/installed-test: extras := [test]
$(VENV)/installed-check: extras := [test,check]
$(VENV)/installed-bench: extras := [bench]
$(VENV)/installed $(VENV)/installed-test $(VENV)/installed-check $(VENV)/installed-bench: \
    pyproject.toml constraints.txt | $(PY)
	$(INSTALL) '.$(extras)'
	@touch $@
