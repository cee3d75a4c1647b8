# The environment is built once, from the pinned list: with uv where it is installed, else with
# venv and pip.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
PINNED := .ci/requirements.txt
# Quick tests of these are run as on a processor whose rounding differs; `make test` runs all here.
ROUNDED := $(addprefix tests/,signals filters learning theory)
# Tools that keep a history and write lists; no test needs them.
TOOLS  := $(CURDIR)/.matrix/tools
UV     := $(shell command -v uv 2>/dev/null)

# The experiments that draw what the papers' figures show, with ours beside the printed numbers.
DRAWN := cao_2019_identification cao_2019_table_1 cao_2019_table_2 dai_2014_figures \
         li_2020_signals li_2020_figures xu_2024_figures xu_2024_tables \
         milc_2024_figures milc_2024_table_1

.DEFAULT_GOAL := help
.PHONY: help run check lint test matrix papers bench history sbom docs wheel clean \
        ruff ty mypy pages

help:  ## this list
	@awk -F ':.*## ' '/^[a-z]+:.*## / {printf "make %-7s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

run: $(VENV)/.ready  ## a sweep over 1024 uncertain motors, to out/sweep-cao-2019
	$(BIN)/jaxilc sweep cao-2019 --out out/sweep-cao-2019 --resume

check: lint  ## lint, format, types, quick tests: a minute on 2 cores
	$(BIN)/python -m pytest -n 2 -m "quick and not slow" $(addprefix --ignore=,$(ROUNDED))
	ISA=SSE4_2 $(BIN)/python -m pytest -n 2 -m "quick and not slow" $(ROUNDED)

test: $(VENV)/.ready  ## as CI runs it: the documentation and all tests, the thorough ones by turns
	$(MAKE) -j 2 mypy pages ty ruff
	$(BIN)/python -m pytest -n 2 -m "not shipped"
	XLA_FLAGS= $(BIN)/python -m pytest -n 2 -m shipped

lint: $(VENV)/.ready  ## lint, format and types alone
	$(MAKE) -j 2 mypy ty ruff

# Most of these use one core, so two of them run side by side.
ruff ty mypy pages: $(VENV)/.ready

ruff:
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

ty:
	$(BIN)/ty check

mypy:
	$(BIN)/mypy

pages:
	JAX_PLATFORMS=cpu $(BIN)/python .ci/docs/render.py

matrix:  ## all tests with Python 3.11, 3.12 and 3.13, where these are, and their speed
	.ci/matrix

papers: $(VENV)/.ready  ## each figure of the papers, ours beside the print, to out/experiments
	for name in $(DRAWN); do $(BIN)/python experiments/$$name.py || exit 1; done
	$(BIN)/jaxilc reproduce --out out/papers --report out/papers/papers.html

bench: $(VENV)/.ready  ## our speed beside NumPy, Numba, C and others; OPTIONS=--help lists options
	$(BIN)/python experiments/benchmark/compare.py $(OPTIONS)

history: $(TOOLS)/.ready  ## the main figures of this commit, by asv, to out/history
	cd .ci/history && $(TOOLS)/bin/asv machine --yes
	cd .ci/history && ASV_PYTHONPATH=$(CURDIR):$$($(CURDIR)/$(BIN)/python -c \
	    'import sysconfig; print(sysconfig.get_path("purelib"))') $(TOOLS)/bin/asv run --quick \
	    --show-stderr -E existing:$(TOOLS)/bin/python --set-commit-hash $$(git rev-parse HEAD)

sbom: $(TOOLS)/.ready  ## what is inside the environment: CycloneDX, to out/sbom.json
	mkdir -p out
	$(TOOLS)/bin/cyclonedx-py requirements --pyproject pyproject.toml --of JSON \
	    -o out/sbom.json $(PINNED)

docs: $(VENV)/.ready  ## guide, tutorials, gallery and API as a site, to out/docs (15 minutes)
	JAX_PLATFORMS=cpu $(BIN)/python .ci/docs/render.py out/docs
	JAXILC_ALL=1 $(BIN)/python -m pytest -n 2 tests/test_examples.py

wheel: $(VENV)/.ready  ## a wheel, to dist
	$(BIN)/python -m build --no-isolation --wheel

clean:  ## remove the environment, out and dist
	rm -rf $(VENV) .matrix out dist

$(VENV)/.ready: $(PINNED) pyproject.toml
ifdef UV
	uv venv --quiet --allow-existing --python $(PYTHON) $(VENV)
	uv pip install --quiet --python $(BIN)/python -r $(PINNED)
	uv pip install --quiet --python $(BIN)/python --no-deps --no-build-isolation -e .
else
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r $(PINNED)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
endif
	touch $@

$(TOOLS)/.ready: $(VENV)/.ready
	$(BIN)/python -m venv $(TOOLS)
	$(TOOLS)/bin/pip install --quiet --disable-pip-version-check "asv>=0.6" "cyclonedx-bom>=5"
	touch $@
