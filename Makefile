# Two commands matter: `make demo` and `make test`. Both make .venv from a lock file first.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
ARGS   ?=
PIP    := $(BIN)/python -m pip --disable-pip-version-check --quiet

.PHONY: setup demo test quick lint bench soak docs lock clean bridge-wheel

setup: $(VENV)/.runtime

$(VENV)/.runtime: requirements.lock pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "AutoSPINe needs Python 3.11 or newer; this is " + sys.version.split()[0])'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP) install --require-hashes -r requirements.lock
	$(PIP) install --no-deps --no-build-isolation --editable .
	touch $@

$(VENV)/.dev: requirements-dev.lock $(VENV)/.runtime
	$(PIP) install --require-hashes -r requirements-dev.lock
	touch $@

demo: $(VENV)/.runtime
	$(BIN)/autospine demo $(ARGS)

# More workers (make test WORKERS=4) are quicker on an idle machine: what starts processes mostly waits.
test: $(VENV)/.dev
	sh tests/system_packages.sh
	$(BIN)/python -m pytest -n $(or $(WORKERS),2) --dist loadfile --no-loadscope-reorder $(ARGS)

# The pure tests: no processes, no browser.
quick: $(VENV)/.dev
	$(BIN)/python -m pytest -n $(or $(WORKERS),2) -m "not process and not soak" $(ARGS)

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/mypy

bench: $(VENV)/.dev
	for script in benchmarks/[a-z]*.py; do $(BIN)/python $$script --quick || exit 1; done

# The bridge alone, for the small computer in the scanner room.
bridge-wheel: $(VENV)/.dev
	cd wheels/robot_bridge && $(abspath $(BIN))/python -m hatchling build -t wheel -d $(CURDIR)/dist

# The long campaigns; the tests run a short form of each.
soak: $(VENV)/.dev
	$(BIN)/python -m pytest -m soak --timeout 0 $(ARGS)

# Needs uv (https://docs.astral.sh/uv). Universal: one file for every platform and Python >= 3.11.
LOCK := uv pip compile --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
	--no-emit-find-links --no-annotate --quiet --custom-compile-command "make lock" pyproject.toml
lock:
	$(LOCK) --extra build -o requirements.lock
	$(LOCK) --extra build --extra dev -o requirements-dev.lock -c requirements.lock

docs: $(VENV)/.dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet

clean:
	rm -rf $(VENV)
