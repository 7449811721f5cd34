# make demo   sets up what is missing and runs the main scenario
# make test   sets up what is missing and runs the tests
# make setup  only sets up .venv (and a libLLVM for the ray tracer); quick when it is done already
# make notebook  opens the notebooks in Jupyter Lab;  make notebooks  runs them anew
# make mutation  plants errors and sees whether anything notices (an hour; docs/validation.md)
# make lint   checks style and types;  make lock  renews requirements.lock;  make clean  removes what was built

.DEFAULT_GOAL := setup
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.PHONY: setup venv backend test demo notebook notebooks mutation lint lock clean

BIN := .venv/bin
STAMP := .venv/.setup-done
# a new environment is made here, and takes the old one's place when it is whole
NEW := .venv.new

# The lock's own tools; kept out of the virtual environment of the project.
LOCK_TOOL := .cache/lock

setup: backend

venv: $(STAMP)

# The first Python >= 3.11 that can make virtual environments. A `python3.x` on the PATH may be a launcher that fails: try it.
$(STAMP): requirements.lock pyproject.toml
	@python=""; \
	for p in python3 python3.13 python3.12 python3.11 python3.14; do \
	  if $$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then python=$$p; break; fi; \
	done; \
	if [ -z "$$python" ]; then \
	  echo "setup: no Python >= 3.11 found; install one (Debian 12, Ubuntu 24.04 and later: apt install python3 python3-venv; \
	Ubuntu 22.04: apt install python3.11 python3.11-venv)" >&2; exit 1; \
	fi; \
	if ! $$python -c 'import ensurepip' 2>/dev/null; then \
	  package=$$($$python -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])'); \
	  { $(call apt,update) && $(call apt,install $$package); } || { \
	    echo "setup: $$python cannot make virtual environments; install its venv package: apt install $$package" >&2; exit 1; }; \
	fi; \
	$$python -c 'import sys; print("setup: Python %d.%d.%d, installing the locked packages into .venv (minutes the first time)" % sys.version_info[:3])'; \
	$$python -m venv --clear $(NEW)
	@n=0; ( while sleep 10; do n=$$((n + 10)); echo "setup: still installing, $$n s"; done ) & beat=$$!; trap "kill $$beat" EXIT; \
	$(NEW)/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes --only-binary :all: -r requirements.lock
	@$(NEW)/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --no-index --editable .
	@grep -rIlF "$(CURDIR)/$(NEW)" $(NEW)/bin | xargs sed -i "s|$(CURDIR)/$(NEW)|$(CURDIR)/.venv|g"
	@rm -rf .venv.old; if [ -e .venv ]; then mv .venv .venv.old; fi; mv $(NEW) .venv; rm -rf .venv.old
	@touch $@

# Dr.Jit needs an NVIDIA GPU or a libLLVM of the right version: ask the program (in isolated mode: nothing else is loaded),
# and fetch the best libllvm package that this Debian or Ubuntu has.
backend: $(STAMP)
	@$(BIN)/python -I isac_rt/runtime.py 2>/dev/null && exit 0; \
	package=$$($(llvm_package) || true); \
	if [ -z "$$package" ]; then $(call apt,update) || true; package=$$($(llvm_package) || true); fi; \
	if [ -n "$$package" ]; then \
	  echo "setup: installing $$package"; \
	  $(call apt,install $$package) 2>/dev/null || { $(call apt,update) && $(call apt,install $$package); } \
	    || echo "setup: apt could not install $$package" >&2; \
	fi; \
	$(BIN)/python -I isac_rt/runtime.py

# 19 where there is one (the version most used here), else the newest that will do
llvm_package = apt-cache search --names-only '^libllvm(17|18|19|20|21|22)(t64)?$$' 2>/dev/null \
  | awk '{ v = substr($$1, 8, 2); print (v == 19 ? 99 : v), $$1 }' | sort -rn | awk 'NR == 1 { print $$2 }'

# apt-get as root or through sudo, silent unless it fails
apt = { command -v apt-get >/dev/null && { as_root=; [ "$$(id -u)" -eq 0 ] || as_root=sudo; \
  $$as_root env DEBIAN_FRONTEND=noninteractive apt-get -y -qq -o=Dpkg::Use-Pty=0 $(1) >/dev/null; }; }

test: setup
	@$(BIN)/python -m pytest -q --durations=10 --numprocesses 2 --dist loadfile

demo: setup
	@$(BIN)/isac-rt run scenes/munich_swarm.yaml --out out/munich_swarm --set compare.paper.preset=paper --overwrite

notebook: setup
	@$(BIN)/jupyter lab notebooks

# the .ipynb files hold what the sources, .py files, show
notebooks: setup
	@cd notebooks && PATH="../$(BIN):$$PATH" PYTHONWARNINGS=ignore::UserWarning jupytext --quiet --to ipynb --set-kernel python3 --execute *.py

mutation: setup
	@$(BIN)/python tests/mutation.py --planted
	@$(BIN)/python tests/mutation.py --hard
	@$(BIN)/python tests/mutation.py --sample 90 --seed 1

lint: venv
	@$(BIN)/ruff format --check .
	@$(BIN)/ruff check .
	@$(BIN)/mypy

# --universal: one lock for every Python >= 3.11; registry addresses stay out of it
lock:
	@test -x $(LOCK_TOOL)/bin/uv || { python3 -m venv $(LOCK_TOOL) && $(LOCK_TOOL)/bin/pip install --quiet uv; }
	@$(LOCK_TOOL)/bin/uv pip compile --quiet --upgrade --universal --python-version 3.11 --extra dev --generate-hashes \
	  --no-emit-index-url --no-emit-find-links --custom-compile-command "make lock" pyproject.toml --output-file requirements.lock

clean:
	rm -rf .venv $(NEW) .cache .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find isac_rt reproduce benchmarks tests -name __pycache__ -type d -prune -exec rm -rf {} +
