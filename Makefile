# make demo: install and imitate a trajectory on a new mug. make test: install and run the tests. make bench: measure against PyTorch.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test bench clean

demo: $(VENV)/.installed
	$(BIN)/tdf imitate --out imitation

test: $(VENV)/.installed-dev
	$(BIN)/python -m pytest

bench: $(VENV)/.installed-bench
	$(BIN)/python -m bench --out runs/bench

$(VENV)/.venv:
	$(PYTHON) -m venv $(VENV)
	touch $@

$(VENV)/.installed: $(VENV)/.venv pyproject.toml
	$(BIN)/pip install --quiet --editable .
	touch $@

$(VENV)/.installed-dev: $(VENV)/.venv pyproject.toml
	$(BIN)/pip install --quiet --editable '.[dev]'
	touch $(VENV)/.installed $@

$(VENV)/.installed-bench: $(VENV)/.venv pyproject.toml
	$(BIN)/pip install --quiet --editable '.[bench]'
	touch $(VENV)/.installed $@

clean:
	rm -rf $(VENV) imitation
