# make study   set-up, then the whole reference study on the twin into out/reference
# make test    set-up, then every check; the last line is pytest's summary
# make check   the unit tests, lint and types: a minute
# A second call does only what its inputs ask for: pyproject.toml sets the packages,
# the C and C++ sources set the extensions.

PYTHON  ?= python3
VENV    := .venv
BIN     := $(VENV)/bin
PIP     := $(BIN)/python -m pip --disable-pip-version-check --quiet
OUT     ?= out/reference
# Two more than there are cores: many tests wait for a time limit or another process.
WORKERS ?= $(shell $(PYTHON) -c 'import os; print(2 + min(os.cpu_count() or 1, 6))')
# Neighbouring tests stay on one worker, which then builds what they share once.
PYTEST  := $(BIN)/python -m pytest -n $(WORKERS) --dist worksteal
FUZZ_S  ?= 1800
# A virtual environment works no more once its folder is moved or its Python is gone or upgraded. Its
# scripts name the folder, which $(VENV)/.tools records.
WORKS   := $(BIN)/python -c 'import os, sysconfig as s; os.listdir(s.get_path("purelib"))' && \
  { [ ! -s $(VENV)/.tools ] || [ "$$(cat $(VENV)/.tools)" = "$$(pwd -P)" ]; }
ifeq ($(shell [ ! -e $(VENV) ] || { $(WORKS); } 2>/dev/null || echo no),no)
  $(info setup: $(VENV) was moved, or its Python is gone; it is created again)
  $(shell rm -rf $(VENV))
endif
NATIVE  := CMakeLists.txt $(wildcard core/*.c core/include/*.h native/*/*.[ch] native/*/*/*.[ch] native/*/*.cpp)

# The tests start hundreds of processes; without its cache each would compile the package anew.
unexport PYTHONDONTWRITEBYTECODE

# The editable installation lists the modules, so it is made again after one was added, moved or removed.
MODULES := $(shell find src/haselab -name '*.py' | LC_ALL=C sort | cksum)
ifneq ($(MODULES),$(shell cat $(VENV)/.modules 2>/dev/null))
  $(shell rm -f $(VENV)/.built)
endif

.PHONY: docs fuzz dist help study test check test-all setup lint ctest tools bench bench-full clean
.DELETE_ON_ERROR:

help:
	@sed -n '1,3s/^# //p' Makefile
	@echo 'make test-all  the slow tests too'
	@echo 'make tools   install with apt what the tests use: compilers, simulators, checkers'
	@echo 'make lint    ruff, mypy, import-linter, which the tests run too'
	@echo 'make ctest   the C core alone, under the sanitizers'
	@echo 'make fuzz    mutated input for every parser for FUZZ_S=1800 seconds; continues where it stopped'
	@echo 'make docs    build the documentation site, out/site/index.html: 3 minutes, or 5 s after a change of one page'
	@echo 'make bench   measure the published figures on a part of the cases: at most 10 minutes'
	@echo 'make bench-full  measure them on all cases: hours'
	@echo 'make setup   virtual environment, extensions, and the packages that the tests need'
	@echo 'make dist    build and check the wheels, the source distribution and the documentation in dist/'
	@echo 'make clean   delete $(VENV), build and caches; out is kept'

study: $(VENV)/.built
	$(BIN)/haselab reproduce --out $(OUT) --force

# Warnings of the C compiler are errors for developers, but not for users, whose compiler may be newer.
test check test-all ctest lint setup: export WERROR ?= ON

test: setup tools
	$(PYTEST) -m 'not slow' --durations=25

check: setup
	$(PYTEST) -m unit

test-all: setup tools
	$(PYTEST)

lint: setup
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports --verbose

ctest: setup tools
	$(BIN)/python -m pytest tests/core

# What the tests use beside Python and a C compiler, as file:package, where a file is a program or a
# path. A test that lacks one is skipped, and make test says so at its end.
TOOLS := avr-gcc:gcc-avr /usr/lib/avr/include/avr/io.h:avr-libc \
  /usr/include/simavr/sim_avr.h:libsimavr-dev /usr/include/libelf.h:libelf-dev \
  arm-none-eabi-gcc:gcc-arm-none-eabi qemu-arm:qemu-user cppcheck:cppcheck \
  git:git clang-tidy:clang-tidy h5dump:hdf5-tools chromium:chromium \
  /usr/lib/*/libaravis-0.8.so.0:libaravis-0.8-0 arv-fake-gv-camera-0.8:aravis-tools

tools:
	@missing=; for tool in $(TOOLS); do file=$${tool%:*}; \
	  { command -v $$file || ls $$file; } >/dev/null 2>&1 || missing="$$missing $${tool##*:}"; \
	done; \
	[ -z "$$missing" ] || .ci/apt-install $$missing || echo 'Tests that need them are skipped.' >&2

fuzz: setup
	$(BIN)/python tests/fuzz/fuzz.py --seconds $(FUZZ_S) --state out/fuzz

bench: setup $(VENV)/.bench
	$(BIN)/python -m benchmarks

bench-full: setup $(VENV)/.bench
	$(BIN)/python -m benchmarks --full

# -W makes warnings errors; -n warns of each reference without a target. Not in parallel: with -j,
# Sphinx 9.0 leaves out pages without a message if one of them fails.
docs: setup
	$(BIN)/python -m sphinx -q -W --keep-going -n -c docs -d out/doctrees . out/site
	@echo 'out/site/index.html'

dist: setup
	$(PYTHON) packaging/dist.py $(if $(TARGETS),--targets $(TARGETS))

setup: $(VENV)/.packages

# ---- set-up ---------------------------------------------------------------------------------

$(VENV)/bin/python:
	@command -v $(PYTHON) >/dev/null || .ci/apt-install python3 python3-venv python3-dev
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo >&2 'haselab needs' \
	  'Python 3.11 or newer. Name one:  make PYTHON=python3.12 ...'; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || .ci/apt-install python3-venv python3-dev
	@$(PYTHON) -m venv $(VENV)

# uv downloads in parallel, but does not read pip's settings. If uv fails, pip is used.
UV := [ -x $(BIN)/uv ] && VIRTUAL_ENV=$(VENV) $(BIN)/uv pip install --quiet
DEVELOPER := --no-build-isolation --editable '.[formats,test,lint,docs]'

# The build tools. CMake and Ninja are large, so those of the system are used if they are new enough.
$(VENV)/.tools: pyproject.toml | $(VENV)/bin/python
	@command -v $${CXX:-c++} >/dev/null && command -v $${CC:-cc} >/dev/null || \
	  .ci/apt-install gcc g++ libc6-dev
	@$(BIN)/python -c 'import os, sys, sysconfig as s; \
	  sys.exit(not os.path.exists(s.get_path("include") + "/Python.h"))' || \
	  .ci/apt-install python3-dev
	@echo 'setup: build tools'
	@# Not there if uv made the environment, or if it was not finished.
	@pip() { $(BIN)/python -m pip --version >/dev/null 2>&1; }; \
	pip || { $(BIN)/python -m ensurepip >/dev/null 2>&1; pip; } || $(PYTHON) -m venv --clear $(VENV)
	@$(PIP) install --no-compile --only-binary :all: uv || echo 'setup: uv could not be installed; using pip' >&2
	@set -- 'scikit-build-core>=1.1' 'nanobind>=2.7' 'setuptools-scm>=9.2' 'setuptools>=70.1' wheel; \
	case "$$(cmake --version 2>/dev/null | sed -n '1s/.* //p')" in \
	  3.2[0-9].*|3.3[0-9].*|[4-9].*) ;; *) set -- "$$@" 'cmake>=3.20' ;; esac; \
	command -v ninja >/dev/null || set -- "$$@" ninja; \
	$(UV) "$$@" || $(PIP) install "$$@"
	@pwd -P >$@

# Packages are downloaded while the extensions are compiled. scikit-build-core keeps its build folder,
# so a later call compiles only what changed.
$(VENV)/.built: $(NATIVE) $(VENV)/.tools
	@echo 'setup: extensions and packages'
	@PATH="$(CURDIR)/$(BIN):$$PATH" $(PIP) install --no-build-isolation --no-deps \
	  $(if $(WERROR),-C cmake.define.HASELAB_WERROR=$(WERROR)) --editable . & compiling=$$!; \
	$(UV) -r pyproject.toml || missing=yes; wait $$compiling && { [ -z "$${missing:-}" ] || \
	$(PIP) install --no-build-isolation --editable .; }
	@$(BIN)/python -m compileall -q src/haselab # else each process compiles it, where no cache may be written
	@echo '$(MODULES)' >$(VENV)/.modules
	@touch $@

# The additional packages that the tests, the checkers and the documentation need.
$(VENV)/.packages: pyproject.toml $(VENV)/.built
	@echo 'setup: packages of the tests'
	@export PATH="$(CURDIR)/$(BIN):$$PATH"; \
	$(UV) $(DEVELOPER) || { echo 'setup: uv could not, pip tries: minutes'; $(PIP) install $(DEVELOPER); }
	@touch $@

$(VENV)/.bench: pyproject.toml $(VENV)/.packages
	@PATH="$(CURDIR)/$(BIN):$$PATH" $(PIP) install --no-build-isolation --editable '.[bench,comparison]'
	@echo 'bench: other libraries for transfer functions, which need an older numpy of their own'
	@$(BIN)/python -m venv $(VENV)/libraries && $(VENV)/libraries/bin/pip --disable-pip-version-check \
	  --quiet install sippy_unipi sysidentpy pysib control || \
	  echo 'bench: not all of them could be installed; the table shows the rest' >&2
	@touch $@

clean:
	rm -rf $(VENV) build .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
