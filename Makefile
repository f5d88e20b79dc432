# make demo    see past the people of a small sample; prints the path of the picture
# make test    the tests
# make bench-speed    the speed of every stage on this machine (make bench is the same)
# make bench-quality DATA=folder    the quality on recordings with truth, beside baselines
# make bench-ablation DATA=folder    what every idea is worth, switched off alone
# make bench-calibration DATA=folder    whether the confidence is right, on recordings with truth
# make bench-gpu    the speed on the GPU, if there is one, and what its data sheet allows
# make docs    the documentation, to build/docs/index.html
# make lint    style and types
#
# Each sets up what it needs in .venv: it asks for Python >= 3.10 and a C++ compiler, nothing else.

VENV   := .venv
PY     := $(VENV)/bin/python
CORE   := $(VENV)/.core-installed
BUILD  := pyproject.toml CMakeLists.txt $(wildcard cpp/*.cpp cpp/*.h)
PYTHON ?= $(shell for p in python3 python3.14 python3.13 python3.12 python3.11 python3.10; do \
  $$p -c 'import sys; sys.exit(sys.version_info < (3, 10))' 2>/dev/null && { echo $$p; break; }; done)
PIP    := $(PY) -m pip --quiet --disable-pip-version-check install

.PHONY: demo test bench bench-speed bench-gpu bench-quality bench-ablation bench-calibration docs lint
.DELETE_ON_ERROR:

demo: $(CORE)
	@$(VENV)/bin/seepast demo --out demo-out

test: $(VENV)/.test-installed
	@$(PY) -m pytest

# PRESETS=paper,... MASKS=masks_exact,... choose; WRITE=benchmarks/RESULTS.md keeps the tables; QUICK=1 for a first look
BENCH := $(if $(PRESETS),--presets "$(PRESETS)") $(if $(WRITE),--write "$(WRITE)")

bench: bench-speed

bench-speed: $(VENV)/.test-installed
	@$(PY) benchmarks/speed.py $(BENCH) $(if $(QUICK),--quick) $(if $(LIBELAS),--libelas "$(LIBELAS)")

bench-gpu: $(VENV)/.test-installed
	@$(PY) benchmarks/gpu.py $(if $(PRESETS),--presets "$(PRESETS)") $(if $(WRITE),--write "$(WRITE)")

bench-quality: $(VENV)/.test-installed
	@test -n "$(DATA)" || { echo "make: say DATA=folder, a recording with truth/ or a folder of such recordings"; exit 1; }
	@$(PY) benchmarks/quality.py "$(DATA)" $(BENCH) $(if $(MASKS),--masks "$(MASKS)") $(if $(SECTION),--section "$(SECTION)")

bench-ablation: $(VENV)/.test-installed
	@test -n "$(DATA)" || { echo "make: say DATA=folder, a recording with truth/ or a folder of such recordings"; exit 1; }
	@$(PY) benchmarks/ablation.py "$(DATA)" $(if $(WRITE),--write "$(WRITE)") $(if $(MASKS),--masks "$(MASKS)")

bench-calibration: $(VENV)/.test-installed
	@test -n "$(DATA)" || { echo "make: say DATA=folder, a recording with truth/ or a folder of such recordings"; exit 1; }
	@$(PY) benchmarks/calibration.py "$(DATA)" $(BENCH) $(if $(MASKS),--masks "$(MASKS)") $(if $(KEEP),--keep "$(KEEP)") $(if $(SECTION),--section "$(SECTION)")

docs: $(VENV)/.docs-installed
	@$(PY) -m sphinx -W --keep-going -q -b html docs build/docs
	@echo build/docs/index.html

lint: $(VENV)/.dev-installed
	$(VENV)/bin/ruff check src tests benchmarks docs/*.py
	$(VENV)/bin/ruff format --check src tests benchmarks docs/*.py
	$(VENV)/bin/mypy src/seepast
	$(VENV)/bin/clang-format --dry-run -Werror cpp/*.cpp cpp/*.h tests/cpp/*.cpp tests/cpp/*/*.h

$(PY):
	@test -n "$(PYTHON)" || { echo "make: no Python >= 3.10 found; install one, or say make PYTHON=/path/to/python3"; exit 1; }
	@command -v c++ g++ clang++ >/dev/null || { echo "make: no C++ compiler found; install g++ or clang++"; exit 1; }
	@echo "making $(VENV) with $(PYTHON)"
	@$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); \
	  echo "make: $(PYTHON) cannot make a virtual environment; on Debian and Ubuntu: apt install python3-venv"; exit 1; }

# Without build isolation the compiled objects are kept, and only what changed is compiled again.
$(CORE): $(BUILD) | $(PY)
	@echo "building seepast in $(VENV)"
	@$(PIP) "scikit-build-core>=0.10" "nanobind>=2.4" "cmake>=3.18" ninja
	@$(PIP) --no-build-isolation --editable .
	@touch $@

# The package is there already: this adds what its extra "test" or "dev" asks for.
$(VENV)/.%-installed: $(CORE)
	@echo "installing what seepast[$*] asks for"
	@$(PIP) "seepast[$*]"
	@touch $@
