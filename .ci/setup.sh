#!/usr/bin/env bash
# Sets up what `make` needs. Without an argument: .venv with the tested versions, and the GL libraries.
# With `browser`: a Chromium for the test of the report page, if it can be had.
set -euo pipefail
cd "$(dirname "$0")/.."

fail() {
    printf 'error: %s\n' "$*" >&2
    exit 1
}

# Prints the first Python that is new enough: $PYTHON, else the ones on the PATH.
find_python() {
    local name
    for name in ${PYTHON:-python3 python3.13 python3.12 python3.11}; do
        if "$name" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
            command -v "$name"
            return
        fi
    done
    fail "Python 3.11 or newer is needed, ${PYTHON:-python3} is $("${PYTHON:-python3}" --version 2>&1 || true);" \
        "install one and name it: make setup PYTHON=/path/to/python3.11"
}

# Installs Debian packages, when this user may: as root or by sudo without a password.
install_debian() {
    command -v apt-get >/dev/null || return 1
    local as_root=()
    if [ "$(id -u)" != 0 ]; then
        sudo -n true 2>/dev/null || return 1
        as_root=(sudo -n)
    fi
    "${as_root[@]}" apt-get update -qq || true
    "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@"
}

can_load() {
    .venv/bin/python -c 'import ctypes, sys; ctypes.CDLL(sys.argv[1])' "$1" 2>/dev/null
}

install_gl() {
    if can_load libEGL.so.1 && can_load libGL.so.1; then
        return
    fi
    echo "installing the GL libraries that MuJoCo renders with"
    install_debian libegl1 libgl1 || fail "the GL libraries are missing and cannot be installed from here;" \
        "run this as an administrator, then try again: apt-get install libegl1 libgl1 libosmesa6"
    install_debian libosmesa6 || echo "libosmesa6 is not to be had; rendering goes through EGL alone"
}

# The first installation takes NEEDED_MB; pip would tell only when the disk is full.
NEEDED_MB=7500
check_room() {
    local free_mb taken_mb
    [ ! -x .venv/bin/zest ] || return 0
    free_mb=$(df -Pm . | awk 'NR == 2 { print $4 }')
    taken_mb=$({ du -sm .venv 2>/dev/null || true; } | cut -f 1)
    [ $((free_mb + ${taken_mb:-0})) -ge $NEEDED_MB ] || fail "the tested packages need $NEEDED_MB MB of disk," \
        "there are $free_mb MB free at $PWD; free some space (old .venv folders, pip cache purge), then try again"
}

install_python_packages() {
    local python
    python=$(find_python)
    check_room
    if ! .venv/bin/python -m pip --version >/dev/null 2>&1; then
        "$python" -m venv --clear .venv || fail "$python cannot make a virtual environment;" \
            "Debian, Ubuntu: apt-get install python3-venv"
    fi
    echo "installing the tested packages into .venv (some minutes, about 7 GB)"
    .venv/bin/python -m pip install --disable-pip-version-check -c constraints.txt -e '.[dev]'
}

install_browser() {
    local name
    for name in chromium chromium-browser google-chrome; do
        if command -v "$name" >/dev/null; then
            return
        fi
    done
    install_debian chromium >/dev/null || fail "no Chromium here; the test that opens the report in a browser is skipped"
}

case "${1:-}" in
    "")
        install_python_packages
        install_gl
        ;;
    browser) install_browser ;;
    *) fail "usage: .ci/setup.sh [browser]" ;;
esac
