# make probe: set up and run a session. make test: set up and run all checks.
# make PYTHON=python3.12 probe: with another Python, 3.11 or newer.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: probe test clean

probe: $(VENV)/.installed
	@if $(BIN)/python -c "import pybullet" 2>/dev/null; then session=simulated; else \
		session=kinematic; \
		echo "PyBullet has no wheel for this Python (it has for 3.11): running session=kinematic"; \
	fi; \
	$(BIN)/python -m runners.probe object=drill method=chsel session=$$session

test: $(VENV)/.installed-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest -n 2 --dist loadfile

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "$(PYTHON) is older than Python 3.11; pass PYTHON=python3.11 or newer"; exit 2; }
	@$(PYTHON) -m venv $(VENV) || \
		{ rm -rf $(VENV); echo "no virtual environment: on Debian, apt install python3-venv"; exit 2; }

$(VENV)/.installed: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable .
	@touch $@

$(VENV)/.installed-test: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[test]"
	@touch $@

clean:
	rm -rf $(VENV) build *.egg-info
