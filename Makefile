# make demo: install and imitate a trajectory on a new mug. make test: install and run the fast tests, in a few minutes.
# make test-all: every test. make test-types: fast tests with checked annotations. make check: format, lint and types.
# make docs: the documentation site, runs/site/index.html. make bench: measure against PyTorch.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
# Large pages, with glibc 2.35 or newer: one file of tests took a fifth less processor time. Other systems ignore it.
PYTEST := GLIBC_TUNABLES=glibc.malloc.hugetlb=1 $(BIN)/python -m pytest

.PHONY: demo test test-all test-types check docs bench clean

demo: $(VENV)/.installed
	$(BIN)/tdf imitate --out imitation

test: $(VENV)/.installed-test
	$(PYTEST) -m "not slow"

test-all: $(VENV)/.installed-dev
	TDF_BROWSER=$${TDF_BROWSER-required} $(PYTEST) -rs

# Annotations of arguments and results of these packages are checked as their functions run, shapes included.
TYPED := geometry io networks energy landscape shapes
test-types: $(VENV)/.installed-dev
	TDF_CHECK_TYPES="$(TYPED)" $(PYTEST) -m "not slow" $(TYPED:%=tests/%)

check: $(VENV)/.installed-check
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright

# Notebooks are shown as `make test-all` kept them, or executed. No network is needed; a warning is an error.
docs: $(VENV)/.installed-docs
	$(BIN)/sphinx-build --quiet --fail-on-warning --keep-going -c docs -d runs/doctrees . runs/site

bench: $(VENV)/.installed-bench
	$(BIN)/python -m bench --out runs/bench

$(VENV)/.venv:
	$(PYTHON) -m venv $(VENV)
	touch $@

# installed again where the version changes
$(VENV)/.installed: $(VENV)/.venv pyproject.toml tdf_jax/_internal/version.py
	$(BIN)/pip install --quiet --editable .
	touch $@

# .installed-NAME: with the extra NAME
$(VENV)/.installed-%: $(VENV)/.venv pyproject.toml tdf_jax/_internal/version.py
	$(BIN)/pip install --quiet --editable '.[$*]'
	touch $(VENV)/.installed $@

clean:
	rm -rf $(VENV) imitation
