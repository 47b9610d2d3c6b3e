# One environment (.venv), made on demand. `make install TORCH=` keeps the torch that is already in it.
# Modules are compiled when they are first imported: most of what is installed never is.
PYTHON ?= python3.11
TORCH ?= torch==2.13.0
BIN = .venv/bin
# A process for each core; a file's tests stay together, for what they share.
PYTEST = $(BIN)/python -m pytest --numprocesses auto --dist loadfile

.PHONY: install demo test torture check lint clean

install: .venv/.installed

.venv/.installed: pyproject.toml perception/pyproject.toml constraints-cpu.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(if $(TORCH),$(BIN)/pip install --quiet --no-compile '$(TORCH)',$(BIN)/python -c 'import torch')
	$(BIN)/pip install --quiet --no-compile $(if $(TORCH),-c constraints-cpu.txt) -e '.[pipeline,dev]' -e perception
	touch $@

demo: install
	$(BIN)/presight --workspace demo demo

# The faults fork a process that must not have touched a store: they have one of their own.
test: install
	$(PYTEST) --ignore tests/torture
	$(PYTEST) tests/torture

# Faults by the thousand: hours. What `make test` injects is the short form of it.
torture: install
	PRESIGHT_TORTURE=1 $(BIN)/python -m pytest --timeout 0 tests/torture tests/storage/test_store_model.py

check: lint
	$(PYTEST) -m "not slow"

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

clean:
	rm -rf .venv build dist *.egg-info perception/build perception/*.egg-info
