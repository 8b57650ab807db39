PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# Many small matrices: threads of the linear algebra would only wait for each other.
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1

.PHONY: demo test test-all bench bench-blind lint

$(STAMP): requirements.lock pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --requirement requirements.lock
	$(BIN)/python -m pip install --quiet --no-deps --editable .
	$(BIN)/python -m ident.precompile
	touch $(STAMP)

demo: $(STAMP)
	$(BIN)/simgap demo --out out/demo --seed 7

# A process a core: threads in each would only wait for each other.
test test-all: export SIMGAP_THREADS = 1

test: $(STAMP)
	$(BIN)/python -m pytest -m "not slow" -n 2 --dist loadgroup

test-all: export HYPOTHESIS_PROFILE = random
test-all: $(STAMP)
	$(BIN)/python -m pytest -n 2 --dist loadgroup

# A quick size; `make bench SIZE=--full` for the figures of the README.
bench: $(STAMP)
	$(BIN)/python benchmarks/bench_plant.py
	$(BIN)/python benchmarks/bench_clean.py
	$(BIN)/python benchmarks/bench_estimators.py $(SIZE)
	$(BIN)/python benchmarks/bench_frf.py $(SIZE)
	$(BIN)/python benchmarks/bench_criteria.py $(SIZE)
	$(BIN)/python benchmarks/bench_paper.py $(SIZE)
	$(BIN)/python benchmarks/bench_prediction.py $(SIZE)
	$(BIN)/python benchmarks/bench_design.py
	$(BIN)/python benchmarks/bench_local.py
	$(BIN)/python benchmarks/bench_diagnose.py
	$(BIN)/python benchmarks/bench_import.py
	$(BIN)/python benchmarks/bench_export.py

bench-blind: $(STAMP)
	$(BIN)/python benchmarks/blind.py --size quick

lint: $(STAMP)
	$(BIN)/ruff check robot_assets sim ident tests benchmarks
	$(BIN)/ruff format --check --quiet robot_assets sim ident tests benchmarks
	$(BIN)/mypy
