# make setup   system libraries and packages; make setup-dev: those of tests and docs, too
# make demo    set everything up and serve the page at http://127.0.0.1:8080
# make site    write the explorer as static files to build/site, and serve it at http://127.0.0.1:8000
# make notebooks   the lessons in JupyterLab (notebooks/README.md)
# make student-copies   copies of the lessons without outputs and solutions, in build/class
# make test    set up the same, then the fast and the real-browser tests; lists the slowest twenty
# make test-slow   trainings and long evaluations, hours
# make style   formatting, import rules and types, in about a minute
# make check   the same, and the documentation's links
# make docs    the documentation as a site in build/docs
# make dist    a wheel and a source archive in dist/
# make release REPOSITORY=ADDRESS   writes the address into four files, then makes wheel, documentation
#               and site, and tries the wheel in a clean environment
# make figures  evaluate every policy on the reporting seeds (hours; goes on where it was stopped),
#               then make pictures
# make bench   every benchmark, into docs/benchmarks.md (20 minutes on an idle machine)
# make pictures  results/RESULTS.md, and figures and pictures in README and docs, from the files
#
# Variables: PYTHON=python3.12      the Python the environment is made from (3.11 or newer)
#            TORCH_INDEX=ADDRESS    where to take torch from, for example the index of its CPU builds
#            ARGS='--port 9000'     more words for madviz explore, or for JupyterLab

PYTHON ?= python3
POLICY ?= metaworld-hammer-mad-light
BIN    := .venv/bin

RELEASED := README.md docs/teaching.md CITATION.cff pyproject.toml

.PHONY: notebooks student-copies help demo site release setup setup-dev test test-slow style check docs figures pictures dist bench clean

help:
	@sed -n '/^$$/q; s/^# \{0,1\}//p' Makefile

demo: setup
	$(BIN)/madviz explore --policy $(POLICY) $(ARGS)

site: build/site
	$(BIN)/python -m http.server --bind 127.0.0.1 --directory build/site 8000

.PHONY: build/site
build/site: .venv/site.stamp
	$(BIN)/madviz site --out build/site --zip $(ARGS)

setup: .venv/packages.stamp

setup-dev: .venv/dev.stamp .venv/browser.stamp

notebooks: .venv/notebooks.stamp
	cd notebooks && ../$(BIN)/jupyter lab $(ARGS)

student-copies: .venv/notebooks.stamp
	$(BIN)/python tools/student_copies.py

test: setup-dev .venv/node.stamp
	$(BIN)/python -m pytest -m "not slow and not e2e" -n 2 --dist worksteal --durations=20
	$(BIN)/python -m pytest -m "e2e and not slow" --durations=20

test-slow: setup-dev .venv/nginx.stamp
	$(BIN)/python -m pytest -m slow

check: style
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet

style: .venv/dev.stamp .venv/node.stamp
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/lint-imports --no-cache
	$(BIN)/pyright
	.venv/node/node_modules/.bin/tsc -p madviz/site/jsconfig.json

docs: .venv/dev.stamp
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

dist: .venv/dev.stamp
	$(BIN)/python -m build --outdir dist .

release: setup-dev .venv/node.stamp
	@test -n "$(REPOSITORY)" || { echo "expected make release REPOSITORY=ADDRESS"; exit 2; }
	sed -i 's|\bREPOSITORY\b|$(REPOSITORY)|; s,^# \(urls.Repository\|repository-code:\),\1,' $(RELEASED)
	$(MAKE) dist docs build/site
	$(BIN)/python -m pytest -m slow tests/test_wheel.py

figures: setup-dev
	$(BIN)/madviz report --evaluate
	$(MAKE) pictures

pictures: setup-dev
	$(BIN)/madviz report
	$(BIN)/python tools/figures.py
	$(BIN)/python tools/fill_figures.py

bench: setup-dev
	$(BIN)/python -m benchmarks render --json results/archive/bench/render.json
	$(BIN)/python -m benchmarks render --suite maniskill --json results/archive/bench/render-maniskill.json
	$(BIN)/python -m benchmarks live --json results/archive/bench/live.json
	$(BIN)/python -m benchmarks live --training --json results/archive/bench/live-training.json
	$(BIN)/python -m benchmarks live --policy toy-reach-mv-mwm-mv-mwm --workers 0 --json results/archive/bench/live-imagined.json
	$(BIN)/python -m benchmarks crowd --json results/archive/bench/crowd.json
	$(BIN)/python -m benchmarks update --json results/archive/bench/update.json
	$(BIN)/python -m benchmarks buffer --json results/archive/bench/buffer.json
	$(BIN)/python -m benchmarks evaluate --workers 2 --json results/archive/bench/evaluate.json
	$(BIN)/python tools/fill_figures.py

clean:
	rm -rf .venv build dist *.egg-info .pytest_cache .ruff_cache

# A stamp is younger than all it was made from, or it is made again; so a second `make demo` starts
# at once. Packages come through uv where it is there, otherwise through pip.

.venv/system.stamp: tools/system.py
	$(PYTHON) tools/system.py
	@mkdir -p .venv && touch $@

.venv/browser.stamp: tools/system.py | .venv/system.stamp
	$(PYTHON) tools/system.py --browser
	@touch $@

.venv/packages.stamp: pyproject.toml constraints.txt | .venv/system.stamp
	PYTHON="$(PYTHON)" TORCH_INDEX="$(TORCH_INDEX)" tools/packages.sh .
	@touch $@

.venv/notebooks.stamp: pyproject.toml constraints.txt | .venv/packages.stamp
	PYTHON="$(PYTHON)" tools/packages.sh '.[notebooks]'
	@touch $@

.venv/site.stamp: pyproject.toml constraints.txt | .venv/packages.stamp .venv/node.stamp
	PYTHON="$(PYTHON)" tools/packages.sh '.[site]'
	@touch $@

# Programs that a site runs in browsers, at the versions of its package.json; none of their scripts
# is run.
.venv/node.stamp: madviz/site/package.json | .venv/system.stamp
	$(PYTHON) tools/system.py --node
	@mkdir -p .venv/node && cp madviz/site/package.json .venv/node/
	cd .venv/node && npm install --ignore-scripts --no-package-lock --no-audit --no-fund
	@touch $@

# Debian's nginx for the tests of proxies, unpacked only: installed, it would serve port 80.
.venv/nginx.stamp: | .venv/system.stamp
	@if command -v apt-get dpkg >/dev/null; then \
	  mkdir -p .venv/nginx && cd .venv/nginx && apt-get download nginx && dpkg -x nginx_*.deb . && touch ../nginx.stamp; \
	else echo "note: no apt here; the tests of proxies need nginx"; fi

.venv/dev.stamp: pyproject.toml constraints.txt | .venv/packages.stamp
	PYTHON="$(PYTHON)" tools/packages.sh '.[test,dev]'
	@touch $@
