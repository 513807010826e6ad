# make demo: track an object in a synthetic clip with known truth, into demo/
# make test: linter, formatter, type checker and all tests
# make clean: remove everything that can be made again
#
# Both make their environment in .venv when it is needed. Another Python: make test PYTHON=python3.12

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt

.PHONY: demo test clean

demo: $(VENV)/installed
	$(BIN)/tracking3d demo --out demo

test: $(VENV)/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/pytest tests plugins

clean:
	rm -rf $(VENV) demo build *.egg-info plugins/*/build plugins/*/*.egg-info
	rm -rf .pytest_cache .mypy_cache .ruff_cache
	find tracking3d tests plugins -name __pycache__ -type d -prune -exec rm -rf {} +

# Editable, so that what runs is what lies here, without installing again after a change.
$(VENV)/installed: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { echo \
	"$(PYTHON) is not Python 3.11 or newer; name one that is, such as: make demo PYTHON=python3.12" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	@echo "Installing into $(VENV); the first time this downloads torch and takes a minute or more."
	$(INSTALL) -e .
	@touch $@

$(VENV)/installed-dev: $(VENV)/installed $(wildcard plugins/*/pyproject.toml)
	$(INSTALL) -e '.[dev]' $(patsubst %/pyproject.toml,-e ./%,$(wildcard plugins/*/pyproject.toml))
	@touch $@
