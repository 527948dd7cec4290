# Everything sets itself up: `make demo` and `make test` need Python 3.11 or newer, make, and the
# package index that pip is configured with. PYTHON=... chooses the interpreter.

VENV := .venv
BIN := $(VENV)/bin
INTERPRETERS := $(or $(PYTHON),python3.12 python3.11 python3 python3.13)
# Build back ends are pinned too: old versions of pip read the first name there, new ones the second.
INSTALL := PIP_CONSTRAINT=constraints.txt PIP_BUILD_CONSTRAINT=constraints.txt \
	$(BIN)/python -m pip install -qq --disable-pip-version-check --no-input -c constraints.txt
PINS := pyproject.toml constraints.txt
# A process grows to four or five gigabytes: more than two would fill a laptop. In the order of the
# files, as the commands take longest: by the number of tests, they would come last and alone. Each
# has a core, so its linear algebra waits for no second thread: that took a tenth of the time.
TESTS := OPENBLAS_NUM_THREADS=1 \
	$(BIN)/python -m pytest --numprocesses=auto --maxprocesses=2 --dist=loadfile \
	--no-loadscope-reorder

.NOTPARALLEL:
.PHONY: help demo test test-all lint format docs clean

help: ## list these targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

demo: $(VENV)/.core ## identify a rope, train a controller, run it, write the report
	@$(BIN)/palpate demo

test: lint ## lint, types and every test that is not slow
	@$(TESTS)

test-all: lint ## the same with the slow tests
	@$(TESTS) -m ""

lint: $(VENV)/.test ## style and types
	@$(BIN)/ruff check
	@$(BIN)/ruff format --check
	@PYRIGHT_PYTHON_IGNORE_WARNINGS=1 $(BIN)/pyright --pythonpath $(BIN)/python

format: $(VENV)/.test ## rewrite the sources in the project's style
	@$(BIN)/ruff check --fix
	@$(BIN)/ruff format

docs: $(VENV)/.docs ## build the documentation into docs/_build/html
	@$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html
	@echo "documentation: docs/_build/html/index.html"

clean: ## remove the environment, caches and what was built; runs/ stays
	rm -rf $(VENV) build dist docs/_build .pytest_cache .ruff_cache .hypothesis .benchmarks
	find src tests benchmarks -name __pycache__ -prune -exec rm -rf {} + 2>/dev/null || true

# pip comes last in a new environment: one that was cut off while being made is made again.
$(BIN)/pip:
	@for python in $(INTERPRETERS); do \
	  "$$python" -c 'import ensurepip, sys, venv; sys.exit(sys.version_info < (3, 11))' \
	    2>/dev/null || continue; \
	  echo "palpate: making $(VENV) with $$("$$python" --version)"; \
	  "$$python" -m venv --clear $(VENV) && exit 0; \
	done; \
	echo "palpate needs Python 3.11 or newer with its venv module (on Debian: python3-venv)," \
	  "and found none as: $(INTERPRETERS); name one with 'make PYTHON=/path/to/python ...'" >&2; \
	exit 1

$(VENV)/.core: $(PINS) | $(BIN)/pip
	@echo "palpate: installing into $(VENV) (about 220 MB the first time)"
	@$(INSTALL) -e .
	@touch $@

$(VENV)/.test: $(PINS) | $(BIN)/pip
	@echo "palpate: installing into $(VENV), with what the tests need (about 300 MB the first time)"
	@$(INSTALL) -e ".[test]"
	@touch $@ $(VENV)/.core

$(VENV)/.docs: $(PINS) | $(BIN)/pip
	@echo "palpate: installing what the documentation needs into $(VENV)"
	@$(INSTALL) -e ".[docs]"
	@touch $@ $(VENV)/.core
