#!/usr/bin/env bash
# Tests exports against the libraries that read them: tests/interop/run.sh CONSUMER…
# Per consumer: .venvs/NAME with the pinned versions of NAME.txt (and NAME.no-deps.txt), built once, then test_NAME.py.
set -euo pipefail
cd "$(dirname "$0")/../.."
here=tests/interop

# Prints the first Python of the given minor version or newer, preferring the ones that the pins were tested with.
find_python() {
    local name
    for name in "python3.$1" python3.11 python3.12 python3.13 python3 "${PYENV_ROOT:-$HOME/.pyenv}"/versions/3.*/bin/python; do
        if "$name" -c "import sys; sys.exit(sys.version_info < (3, $1))" 2>/dev/null; then
            command -v "$name"
            return
        fi
    done
    return 1
}

# Chained by hand: bash ignores `set -e` within what an `if` asks.
build() {
    local name=$1 python=$2 venv=.venvs/$1 others=()
    if [ -e "$here/$name.no-deps.txt" ]; then others=(-r "$here/$name.no-deps.txt"); fi
    "$python" -m venv --clear "$venv" &&
        "$venv/bin/python" -m pip install -qq --disable-pip-version-check -r "$here/$name.txt" &&
        "$venv/bin/python" -m pip install -qq --disable-pip-version-check --no-deps "${others[@]}" -e . &&
        touch "$venv/.complete"
}

# A policy that d3rlpy trained acts in the kitchen, in d3rlpy's own Python.
comes_back() {
    [ "$1" != d3rlpy ] || ZEST_D3RLPY_PYTHON=$PWD/.venvs/d3rlpy/bin/python .venv/bin/python -m pytest -q tests/agents/test_foreign.py -k d3rlpy
}

is_built() {
    local file
    [ -e ".venvs/$1/.complete" ] || return 1
    for file in "$here/$1".txt "$here/$1".no-deps.txt; do
        if [ "$file" -nt ".venvs/$1/.complete" ]; then
            return 1
        fi
    done
}

for name in "$@"; do
    if [ ! -e "$here/test_$name.py" ]; then
        echo "error: no consumer $name; there are: $(cd $here && ls test_*.py | sed 's/test_\(.*\)\.py/\1/' | xargs)" >&2
        exit 2
    fi
done

echo "making the dataset and its exports"
.venv/bin/python $here/make_exports.py build/interop

results=()
failed=0
for name in "$@"; do
    minor=11
    if [ "$name" = lerobot ]; then minor=12; fi
    if ! python=$(find_python $minor); then
        results+=("$name: skipped, it needs Python 3.$minor or newer")
        continue
    fi
    if ! is_built "$name"; then
        echo "building .venvs/$name"
        if ! build "$name" "$python"; then
            results+=("$name: FAILED, .venvs/$name cannot be built")
            failed=1
            continue
        fi
    fi
    if ZEST_INTEROP=$PWD/build/interop D4RL_SUPPRESS_IMPORT_ERROR=1 OMP_NUM_THREADS=1 \
        ".venvs/$name/bin/python" -m pytest -c $here/pytest.ini "$here/test_$name.py" && comes_back "$name"; then
        results+=("$name: passed")
    else
        results+=("$name: FAILED")
        failed=1
    fi
done
printf '%s\n' "" "${results[@]}"
exit $failed
