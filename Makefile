# The two commands are `make demo` and `make test`; each makes .venv and installs by itself. PYTHON=... chooses another interpreter.

VENV := .venv
BIN := $(VENV)/bin
LOCK := constraints.txt
LOCKER := build/lock
PIP := $(BIN)/python -m pip install --constraint $(LOCK)
OUT := runs/demo
TABLE := runs/table
COMMA := ,
BARE := synthetic length=90 texture=false
ROOMS := $(foreach s,0 1 2,"synthetic length=90 seed=$(s)"$(COMMA))"$(BARE) seed=0"$(foreach s,1 2,$(COMMA)"$(BARE) seed=$(s)")
SEQUENCES := $(wildcard ../shared/data/*/)
USABLE := 'import sys, venv, ensurepip; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 14))'
PYTHON := $(shell for p in python3.14 python3.13 python3.12 python3.11 python3.10 python3 python; do \
	$$p -c $(USABLE) >/dev/null 2>&1 && echo $$p && break; done)

.PHONY: demo test test-slow test-newest benchmark table results docs release lock install clean
.DELETE_ON_ERROR:
.NOTPARALLEL:

demo: $(VENV)/base  ## track the built-in synthetic room; installs what that needs, without the tools of developers
	$(BIN)/trihedron run out=$(OUT)
	@echo
	@echo "Look at $(OUT)/trajectory.png (the path and its errors), $(OUT)/metrics.json, $(OUT)/timing.json,"
	@echo "$(OUT)/trajectory.txt (TUM format) and $(OUT)/run.mcap (opens in Foxglove; rerun one stage of it with"
	@echo "  $(BIN)/trihedron run replay=$(OUT)/run.mcap 'only=[manhattan,rotation]')"

SHELL := bash
TIMED := TIMEFORMAT='tests took %R s, %U s of CPU and %S s of the system'; time
test: install  ## style, types, and the tests that are quick
	$(BIN)/ruff check .
	$(BIN)/mypy -p trihedron
	$(TIMED) $(BIN)/pytest -n 2 --dist loadfile --durations=20

test-slow: install  ## the tests that take longer
	$(BIN)/pytest -n 2 --dist loadfile -m slow

test-newest:  ## the same with the newest version of everything, in an environment of its own; prints what differs from the lock
	$(MAKE) install VENV=.venv-newest LOCK=/dev/null
	.venv-newest/bin/python .ci/differences.py constraints.txt
	$(MAKE) test VENV=.venv-newest LOCK=/dev/null

benchmark: install  ## time, memory and error on the synthetic room and the sequences beside this folder
	$(BIN)/trihedron benchmark
	@set -e; for folder in $(SEQUENCES); do echo; echo "$$folder"; $(BIN)/trihedron benchmark $$folder; done

table: install  ## the paper's study and its pages: every system on rooms and DATA="tum:FOLDER icl_nuim:FOLDER ..."; goes on where it was stopped
	$(BIN)/trihedron run -m experiment=paper out=$(TABLE) 'sequences=[$(foreach d,$(DATA),"$(d)"$(COMMA))$(ROOMS)]' || test $$? -eq 1
	$(BIN)/trihedron run -m graph=structural,structural_paper,points dataset.scene=corridor out=$(TABLE)_corridor || test $$? -eq 1
	$(BIN)/trihedron compare $(TABLE) --baseline graph=points --csv $(TABLE)/table.csv --markdown $(TABLE)/table.md \
		--latex $(TABLE)/table.tex --json $(TABLE)/table.json
	$(BIN)/trihedron paper $(TABLE) $(TABLE)_corridor --markdown $(TABLE)/paper.md
	$(BIN)/trihedron site $(TABLE) $(TABLE)_corridor --out $(TABLE)/site

PART := sequences
results: install  ## measure docs/results/PART.json (PART=sequences, honesty or methods; DATA as for table) and write it into the pages; goes on where it was stopped
	$(BIN)/python docs/results/measure.py $(PART) $(or $(foreach d,$(DATA),"$(d)"),$(SEQUENCES))
	$(BIN)/python docs/results/render.py

docs: install  ## the documentation as a site in build/site; executes the gallery
	$(BIN)/python docs/site/gallery.py build/gallery
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	$(BIN)/python docs/site/check.py build/site

CODE := src/trihedron/machine_code
release: install  ## wheel with machine code for this Python, and sdist, checked; the wheel, in an empty environment, tracks the demo and compiles nothing
	rm -rf dist build/release $(CODE)
	$(BIN)/trihedron compile --archive build/machine_code
	mkdir $(CODE) && cp build/machine_code/*.zip $(CODE)
	$(BIN)/python -m build --no-isolation --sdist --wheel --outdir dist; done=$$?; rm -r $(CODE); exit $$done
	$(BIN)/twine check --strict dist/*
	$(PYTHON) -m venv build/release/env
	build/release/env/bin/pip install --quiet --constraint $(LOCK) dist/*.whl
	cd build/release && env/bin/trihedron --version && time XDG_CACHE_HOME=cache env/bin/trihedron run dataset.length=60 out=demo 2>said
	cat build/release/said && ! grep -q compiling build/release/said

lock: $(LOCKER)/bin/uv  ## write constraints.txt: the newest versions of everything on all supported Pythons
	$< pip compile --quiet --universal --python-version 3.10 --all-extras --upgrade --no-annotate --no-emit-index-url --no-emit-find-links \
		--custom-compile-command "make lock" --output-file constraints.txt pyproject.toml

install: $(VENV)/checked $(VENV)/compiled

clean:  ## remove what make made; runs/ stays
	rm -rf .venv .venv-newest build dist src/*.egg-info .mypy_cache .ruff_cache .pytest_cache

$(VENV)/created $(LOCKER)/created:
	@test -n "$(PYTHON)" || { echo "trihedron: needs Python 3.10 to 3.14 with venv; install it with: apt-get install python3 python3-venv" >&2; exit 1; }
	$(PYTHON) -m venv $(@D)
	@touch $@

$(LOCKER)/bin/uv: $(LOCKER)/created $(LOCK)
	$(LOCKER)/bin/python -m pip install --quiet --constraint $(LOCK) uv
	@touch $@

# Build tools first: packages without wheels, and this one, are built with the locked ones.
$(VENV)/installed: $(VENV)/created pyproject.toml $(LOCK)
	@echo "Installing into $(VENV) (about 1 GB to download the first time)"
	$(PIP) --quiet --upgrade pip setuptools
	$(PIP) --upgrade --upgrade-strategy eager --no-build-isolation -e ".[dev]"
	@touch $(VENV)/base $@

# Without the bytecode of all that is never imported: the first run makes that of the rest.
$(VENV)/base: $(VENV)/created pyproject.toml $(LOCK)
	@echo "Installing into $(VENV) (about 450 MB to download the first time)"
	$(PIP) --quiet --upgrade pip setuptools
	$(PIP) --upgrade --upgrade-strategy eager --no-build-isolation --no-compile -e .
	@touch $@

# 3: a library that only some stages use is missing; said each time, until it is there.
$(VENV)/checked: $(VENV)/installed
	@$(BIN)/python -m trihedron.tools.system_check && touch $@ || test $$? -eq 3

# The kernels of the default graph; what is compiled is cached in the user's cache folder (docs/decisions.md).
$(VENV)/compiled: $(VENV)/installed
	@echo "Compiling the kernels (a minute or two, once)"
	@$(BIN)/trihedron compile >$(VENV)/compile.log 2>&1 || true
	@touch $@
