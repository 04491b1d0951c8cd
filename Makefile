# Needs Python 3.10 or newer and make; everything else goes into .venv.
PYTHON ?= python3
VENV ?= .venv
# Windows has no bin
BIN := $(VENV)/$(if $(filter Windows_NT,$(OS)),Scripts,bin)
OUT ?= demo-out

.PHONY: demo test test-all fuzz check format docs bench figures clean

# made again when the dependencies change
$(VENV)/.installed: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10) and "Python 3.10 or newer is needed, this is " + sys.version.split()[0] + "; say make PYTHON=python3.12")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install -qq --disable-pip-version-check --upgrade pip
	$(BIN)/python -m pip install -qq --disable-pip-version-check --editable '.[dev]'
	@touch $@

demo: $(VENV)/.installed
	$(BIN)/rsundistort run sample_scenes/courtyard/photos -o $(OUT) --overwrite
	$(BIN)/rsundistort evaluate $(OUT) --truth sample_scenes/courtyard/ground_truth.json
	@echo
	@echo "Look at: sample_scenes/courtyard/photos/0003.jpg (the rolling shutter bent it)"
	@echo "         $(OUT)/images/0003.jpg (rectified)"
	@echo "         sample_scenes/courtyard/global/0003.jpg (the truth)"
	@echo "Open $(OUT)/report.html in a browser: before and after, the cameras in 3-D, whether to trust it."
	@echo "Open $(OUT)/sparse in COLMAP, or $(OUT)/transforms.json in nerfstudio."

# files of tests side by side, a core each: what solves in one does not wait for what waits for a process in another;
# a hundred processes start, so that bytecode is kept, whatever the environment says
TEST := OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile

test: $(VENV)/.installed
	$(TEST)

test-all: $(VENV)/.installed
	$(TEST) -m "slow or not slow"

# damaged files of every format, some 20,000; RSUNDISTORT_FUZZ_SEED=N repeats a run (docs/hardening.md)
fuzz: $(VENV)/.installed
	RSUNDISTORT_FUZZ=$(or $(FUZZ),20000) $(BIN)/python -m pytest -s tests/fuzz -k test_damaged_files

check: $(VENV)/.installed docs
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# Markdown of docs/ as a site, in docs/_build/html; a warning is an error, and so is a link to what is not there
docs: $(VENV)/.installed
	$(BIN)/sphinx-build -q -E -W --keep-going -b html docs docs/_build/html

format: $(VENV)/.installed
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

# times against the peers; the whole run needs ../shared
bench: $(VENV)/.installed
	$(BIN)/python benchmarks/bench.py

# the other figures of the README; needs ../shared
figures: $(VENV)/.installed
	$(BIN)/python benchmarks/accuracy.py
	$(BIN)/python benchmarks/worth.py
	$(BIN)/python benchmarks/truth.py
	$(BIN)/python benchmarks/depth.py
	$(BIN)/python benchmarks/solve.py
	$(BIN)/python benchmarks/memory.py
	$(BIN)/python benchmarks/field.py

clean:
	rm -rf $(VENV) $(OUT) docs/_build build *.egg-info
