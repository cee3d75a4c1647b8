# The environment is built once, from the pinned list: with uv where it is installed, else with venv and pip.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
PINNED := .ci/requirements.txt
UV     := $(shell command -v uv 2>/dev/null)

.PHONY: run test docs wheel clean

run: $(VENV)/.ready
	$(BIN)/jaxilc sweep cao-2019 --out out/sweep-cao-2019 --resume

test: $(VENV)/.ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/ty check
	JAX_PLATFORMS=cpu $(BIN)/python .ci/docs/render.py
	$(BIN)/python -m pytest -n 2

docs: $(VENV)/.ready
	JAX_PLATFORMS=cpu $(BIN)/python .ci/docs/render.py out/docs

wheel: $(VENV)/.ready
	$(BIN)/python -m build --no-isolation --wheel

clean:
	rm -rf $(VENV) out dist

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
