# Everything runs in a virtual environment in .venv, which the first target that needs it sets up.

VENV := .venv
PYTHON := $(VENV)/bin/python
# A demo needs the project's own libraries only, everything else those of the tests as well.
INSTALLED := $(VENV)/.installed
FOR_TESTS := $(VENV)/.installed-for-tests
OLDEST := .venv-oldest
# A recipe with the word MAKE would run even by make -n.
BY_ITSELF = $(MAKE) --no-print-directory
WITH_LLVM = $(call with_packages,$(PYTHON) -m twin.backend.llvm,libatomic1$(if $(filter x86_64,$(shell uname -m)),, libllvm19))
WITH_ARAVIS = $(call with_packages,$(PYTHON) -m uwlts.runtime.optional_library,libaravis-0.8-0)
WITH_BROWSER = $(call with_packages,$(PYTHON) -m tests.browser,chromium-headless-shell fonts-dejavu-core)

# An activated environment, or settings that redirect Python or pip, must not reach into .venv. Without bytecode each
# process would compile the project and the tests again.
unexport PYTHONDONTWRITEBYTECODE PYTHONPATH PYTHONHOME VIRTUAL_ENV PIP_USER PIP_TARGET PIP_PREFIX PIP_REQUIRE_VIRTUALENV
export PIP_DISABLE_PIP_VERSION_CHECK := 1
export PIP_NO_INPUT := 1

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo test test-full oldest check style types fuzz soak bench results docs setup clean

help:
	@echo "make demo    scan with the simulated sensor and show the result"
	@echo "make test    check the style and run the tests, without the slow ones"
	@echo "make test-full   make check, and all tests, slow studies of statistics and campaigns included"
	@echo "make oldest  run documented commands with the oldest allowed libraries, in $(OLDEST) (make test-full does it too)"
	@echo "make check   only check the code: format, lint, layers of imports, idioms, types, licences, size; lists old results"
	@echo "make fuzz    read many damaged files; CASES=5000 of each kind, READERS=\"capture sensor\" only these"
	@echo "make soak    record 100,000 images by the desk and watch its memory; IMAGES=1000 only so many"
	@echo "make bench   measure speed"
	@echo "make results   measure the tables of docs/results again (days); STALE=1 only those whose code has changed"
	@echo "make docs    build the documentation site in docs/_build/html"
	@echo "make setup   only prepare .venv and libLLVM (the targets above do it too)"
	@echo "make clean   remove .venv, $(OLDEST), caches and build results"

demo: $(INSTALLED)
	@$(WITH_LLVM)
	@$(PYTHON) -m twin demo

test: PYTEST_OPTIONS := -m "not slow"
test-full: AFTERWARDS := types oldest
# Threads of several test processes on two cores would wait for each other in every small product of matrices.
test test-full: export OPENBLAS_NUM_THREADS := 1
test test-full: style
	@$(WITH_ARAVIS)
	@# Without a browser only the tests of pages fail; without any font a page shows no text.
	-@$(WITH_BROWSER)
	@# Nothing runs beside the tests: many check times, also on a slow machine.
	@$(PYTHON) -m pytest -q -n 3 --dist loadfile --no-loadscope-reorder --durations=10 $(PYTEST_OPTIONS); failed=$$?; \
	if [ $$failed = 1 ]; then \
		echo "Tests that failed run once more, alone. Who passes only now depends on what runs beside it:"; \
		$(PYTHON) -m pytest -v --last-failed --maxfail=4 $(PYTEST_OPTIONS); failed=$$?; \
	fi; \
	$(if $(AFTERWARDS),$(BY_ITSELF) --keep-going --jobs=2 --output-sync=target $(AFTERWARDS) || failed=$$?;) exit $$failed

# Compiled loops are kept apart: both environments would replace those of the other.
oldest: export NUMBA_CACHE_DIR := $(CURDIR)/$(OLDEST)/numba
oldest: export OPENBLAS_NUM_THREADS := 1
oldest: setup $(OLDEST)/.installed
	@$(WITH_ARAVIS)
	@echo "oldest: documented commands with the oldest allowed libraries"
	@# They use what newer libraries below them call outdated.
	@$(OLDEST)/bin/python -m pytest -q -n 2 --dist loadfile -W default::DeprecationWarning \
		tests/test_documentation.py tests/system/test_documented_commands.py \
		-k "test_documentation or README or api.md or large-clouds"

check: style types
	@$(PYTHON) -m pytest -q tests/test_licences.py tests/test_budget.py
	@$(PYTHON) -m docs.studies.result_tables

style: setup
	@$(PYTHON) -m ruff format --check --quiet .
	@$(PYTHON) -m ruff check --quiet .
	@$(VENV)/bin/lint-imports --no-logo
	@$(PYTHON) tests/plain_language.py

types: setup
	@$(VENV)/bin/basedpyright --threads 2

fuzz: setup
	@$(PYTHON) -m tests.fuzz $(if $(CASES),--cases $(CASES)) $(READERS)

soak: setup
	@$(WITH_ARAVIS)
	@$(WITH_BROWSER)
	@$(PYTHON) -m tests.soak $(IMAGES)

bench: setup
	@$(PYTHON) -m tests.bench

# The cheapest studies run first. When it was stopped, it continues with the study that was stopped.
results: setup
	@$(PYTHON) -m pip install --quiet --editable '.[results]'
	@$(WITH_ARAVIS)
	@$(PYTHON) -m docs.studies.result_tables --run $(if $(STALE),--stale)

docs: setup
	@$(PYTHON) -m pip install --quiet --editable '.[docs]'
	@$(PYTHON) -m sphinx -W --keep-going -q -b html docs docs/_build/html
	@echo "documentation: docs/_build/html/index.html"

setup: $(FOR_TESTS)
	@$(WITH_LLVM)

$(INSTALLED) $(FOR_TESTS): pyproject.toml
	@$(PYTHON) -m pip --version >/dev/null 2>&1 || { \
		rm -rf $(VENV) && $(call create_venv,$(VENV),python3.13 python3.12 python3.11 python3); }
	@echo "setup: installing the project and its libraries into $(VENV) (about a minute)"
	@$(PYTHON) -m pip install --quiet --no-compile --editable '.$(if $(filter $@,$(FOR_TESTS)),[test])'
	@$(call write_bytecode,$(VENV))
	@echo "setup: compiling the loops for stripes (some seconds)"
	@$(PYTHON) -c "from uwlts.stripe import warm_up; warm_up()"
	@touch $(INSTALLED) $@

# Their wheels are for Python 3.11 and 3.12.
$(OLDEST)/.installed: pyproject.toml tests/oldest.py | $(INSTALLED)
	@rm -rf $(OLDEST)
	@$(call create_venv,$(OLDEST),python3.11 python3.12)
	@echo "setup: installing the oldest allowed libraries into $(OLDEST) (about a minute)"
	@$(PYTHON) -m tests.oldest test >$(OLDEST)/oldest.txt
	@$(OLDEST)/bin/python -m pip install --quiet --no-compile --only-binary :all: --editable . \
		--requirement $(OLDEST)/oldest.txt
	@$(call write_bytecode,$(OLDEST))
	@touch $@

clean:
	@rm -rf $(VENV) $(OLDEST) build dist docs/_build *.egg-info .pytest_cache .ruff_cache .hypothesis
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +

# Runs the command $(1), which fails where a library or program is missing; as root on Debian and Ubuntu the packages $(2)
# are installed then, and it runs again.
define with_packages
$(1) 2>/dev/null || { \
	if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
		echo "setup: installing $(2) (apt-get install)"; \
		for step in install update install; do \
			if [ $$step = update ]; then apt-get update; \
			else DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends -o DPkg::Lock::Timeout=120 $(2) && break; \
			fi; \
		done >/dev/null 2>&1 </dev/null; \
	fi; \
	$(1); \
}
endef

# Writes the bytecode of the libraries of the environment $(1) on all processors; pip would do it on one, in twice the
# time. Some libraries contain files for other Pythons, which do not compile.
write_bytecode = $(1)/bin/python -m compileall -q -j 0 $(1)/lib >/dev/null 2>&1 || true

# Makes the environment $(1) with the first of the Pythons $(2) that is new enough and brings pip along; on Debian pip
# comes with an extra package.
define create_venv
{ \
	python=; incomplete=; \
	for name in $(2); do \
		$$name -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || continue; \
		if $$name -c 'import venv, ensurepip' 2>/dev/null; then python=$$name; break; fi; \
		incomplete=$${incomplete:-$$name}; \
	done; \
	if [ -z "$$python$$incomplete" ]; then \
		echo "error: none of the Pythons tried is there, in version 3.11 or newer: $(2). Install one" \
			"(Debian, Ubuntu: apt-get install python3 python3-venv) and run make again." >&2; \
		exit 2; \
	fi; \
	if [ -z "$$python" ] && [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
		package=$$($$incomplete -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])'); \
		echo "setup: installing $$package (apt-get install)"; \
		log=$$(mktemp); \
		for step in install update install; do \
			if [ $$step = update ]; then apt-get update; \
			else DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends "$$package" && break; \
			fi; \
		done >"$$log" 2>&1 </dev/null; \
		if $$incomplete -c 'import venv, ensurepip' 2>/dev/null; then python=$$incomplete; \
		else tail -n 5 "$$log" >&2; fi; \
		rm -f "$$log"; \
	fi; \
	if [ -n "$$python" ]; then \
		echo "setup: creating $(1) with $$python"; \
		"$$python" -m venv $(1); \
	elif command -v virtualenv >/dev/null; then \
		echo "setup: creating $(1) with virtualenv and $$incomplete"; \
		virtualenv --quiet --python "$$incomplete" $(1); \
	else \
		echo "error: $$incomplete has no venv with pip. Install it (Debian, Ubuntu: apt-get install python3-venv) or" \
			"install virtualenv, and run make again." >&2; \
		exit 2; \
	fi; \
}
endef
