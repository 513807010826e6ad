# make demo: track an object in a synthetic clip with known truth, into demo/
# make test: linter, formatter, type checker and all tests
# make docs: the documentation as a site, into build/site
# make clean: remove everything that can be made again
#
# All make their environment in .venv when it is needed. Another Python: make test PYTHON=python3.12

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Of what is installed a quarter is imported, and compiled then: all of it would take 17 s more.
INSTALL := $(BIN)/python -m pip install --no-compile --quiet --disable-pip-version-check -c constraints.txt
TESTS := OPENBLAS_NUM_THREADS=1 $(BIN)/pytest tests plugins -n logical --maxprocesses 8 --dist loadfile --no-loadscope-reorder

# Modules and what pytest makes of tests are compiled once, and not by every process.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo test docs clean

demo: $(VENV)/installed
	$(BIN)/tracking3d demo --out demo

# The types are checked beside the tests, and what that says is printed after them. Kernels are compiled once, before
# the workers would each do so. A worker takes up to a gigabyte, hence no more than eight; a file's tests share its
# fixtures, so one worker runs them all.
test: $(VENV)/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	@said=$$(mktemp); trap 'rm -f "$$said"' EXIT; \
	echo "$(BIN)/mypy &"; $(BIN)/mypy >"$$said" 2>&1 & types=$$!; \
	$(BIN)/python -m tracking3d.runtime.kernels_ahead 2>/dev/null; \
	echo "$(TESTS)"; $(TESTS); tests=$$?; \
	wait $$types; types=$$?; cat "$$said"; exit $$((tests || types))

# Broken links are errors.
docs: $(VENV)/installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict
	@echo "Open build/site/index.html, or, for the search: $(BIN)/python -m http.server -d build/site"

clean:
	rm -rf $(VENV) demo build *.egg-info plugins/*/build plugins/*/*.egg-info
	rm -rf .pytest_cache .mypy_cache .ruff_cache
	find tracking3d tests plugins -name __pycache__ -type d -prune -exec rm -rf {} +

# Editable, so that what runs is what lies here, without installing again after a change. Plug-ins are built with what
# `dev` installs, and not each in an environment of its own.
$(VENV)/created:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { echo \
	"$(PYTHON) is not Python 3.11 or newer; name one that is, such as: make demo PYTHON=python3.12" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	@touch $@

$(VENV)/installed: $(VENV)/created pyproject.toml plugins/tracking3d-bench/pyproject.toml constraints.txt
	@echo "Installing into $(VENV); the first time this downloads torch and takes a minute or more."
	$(INSTALL) -e . -e ./plugins/tracking3d-bench
	@touch $@

$(VENV)/installed-dev: $(VENV)/created pyproject.toml constraints.txt $(wildcard plugins/*/pyproject.toml)
	@echo "Installing into $(VENV); the first time this downloads torch and takes a minute or more."
	$(INSTALL) -e '.[dev]'
	$(INSTALL) --no-build-isolation $(patsubst %/pyproject.toml,-e ./%,$(wildcard plugins/*/pyproject.toml))
	@touch $@

$(VENV)/installed-docs: $(VENV)/installed
	$(INSTALL) -e '.[docs]'
	@touch $@
