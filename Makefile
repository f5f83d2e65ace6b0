# Every target sets up what it needs: a machine with Python 3.11 and make is enough.
PYTHON ?= python3.11
VENV ?= .venv
BIN = $(VENV)/bin
SCENE ?= 3ladder

# One thread a process: parallel work runs in processes.
export OMP_NUM_THREADS = 1
export OPENBLAS_NUM_THREADS = 1

STARTS ?= 20
SCENES = 5pendulum 6pendulum 2ladder 3ladder ballscroll balldrop particlecar simplecubli

.PHONY: validate test lint package reports clean

validate: $(VENV)/ready
	$(BIN)/mbds-xsim validate $(SCENE) --json out/$(SCENE).json --html out/$(SCENE).html

test: $(VENV)/ready
	MBDS_XSIM_MUST_RUN=mujoco,pybullet,dart,exudyn $(BIN)/python -m pytest

lint: $(VENV)/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

package: $(VENV)/ready
	rm -rf dist
	$(BIN)/python -m build --wheel --outdir dist . >/dev/null
	$(BIN)/check-wheel-contents dist/*.whl

$(VENV)/ready: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	touch $@

# A verdict of fail (exit code 1) is a result too.
reports: $(VENV)/ready
	for scene in $(SCENES); do \
		$(BIN)/mbds-xsim validate $$scene --trajectories $(STARTS) --seed 1 \
			--json reports/$$scene.json --markdown reports/$$scene.md \
			|| [ $$? -eq 1 ] || exit; \
	done
	$(BIN)/python benchmarks/contact_limits.py > reports/contact-limits.md

clean:
	rm -rf $(VENV) build dist out *.egg-info .mypy_cache .ruff_cache .pytest_cache
