#!/bin/sh
# Make .venv and install wavefocus into it; does nothing when that is done already.
#   tools/set-up.sh [EXTRA]      EXTRA: plates, window, test, test-all, lint, docs or bench; PYTHON names the interpreter to start from
set -eu
unset CDPATH PYTHONPATH PYTHONHOME __PYVENV_LAUNCHER__ 2>/dev/null || true
PIP_USER=0 PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_INPUT=1
export PIP_USER PIP_DISABLE_PIP_VERSION_CHECK PIP_NO_INPUT
cd "$(dirname "$0")/.."

extra=${1:-}
stamp=".venv/installed${extra:+-$extra}"
# What the installation depends on: the project's description, and where it lies (the install points there).
wanted=$({ pwd; cat pyproject.toml constraints.txt; } | cksum)

say() { echo "set-up: $*" >&2; }

recent() { "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; }

# Prints the first Python that is recent enough, as the interpreter beneath any active virtual environment.
find_python() {
    for name in ${PYTHON:-python3 python3.14 python3.13 python3.12 python3.11 python}; do
        if command -v "$name" >/dev/null 2>&1 && recent "$name"; then
            "$name" -c 'import sys; print(getattr(sys, "_base_executable", "") or sys.executable)'
            return
        fi
    done
    say "wavefocus needs Python 3.11 or later and found none (looked for ${PYTHON:-python3, python3.11 to python3.14});" \
        "install one, or name it: make ... PYTHON=/path/to/python3"
    return 1
}

make_venv() {
    python=$(find_python)
    package="python$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')-venv"
    if ! "$python" -c 'import ensurepip, venv' >/dev/null 2>&1; then
        CI= "$(pwd)/tools/system-packages.sh" "$package"
        if ! "$python" -c 'import ensurepip, venv' >/dev/null 2>&1; then
            say "$python cannot make virtual environments; install $package (sudo apt-get install $package) and try again"
            exit 1
        fi
    fi
    rm -rf .venv
    say "making .venv with $("$python" --version)"
    "$python" -m venv --without-pip .venv
}

has_pip() { .venv/bin/python -c 'import pip' >/dev/null 2>&1; }

whole() { recent .venv/bin/python && has_pip; }

usable() {
    (cd / && "$OLDPWD/.venv/bin/python" -c '
import wavefocus, numpy, scipy.fft, h5py, pydantic, rich, matplotlib, jinja2, soundfile') >/dev/null 2>&1
}

# uv installs in seconds what takes pip half a minute. Where it cannot (no wheel for this system, another index), pip does.
install() {
    say "installing wavefocus${extra:+ with what \"$extra\" needs} into .venv (needs the network)"
    rm -f "$stamp"
    by_uv || by_pip || {
        say "pip could not install; its reason stands above. Try again, or start afresh with: make clean"
        exit 1
    }
}

by_uv() {
    beneath=$(.venv/bin/python -c 'import sys; print(getattr(sys, "_base_executable", sys.executable))')
    [ -x .venv/bin/uv ] || get_uv || return 1
    # uv does not read the settings of pip, where a lab may name an index of its own.
    index=${UV_DEFAULT_INDEX:-${PIP_INDEX_URL:-$("$beneath" -m pip config get global.index-url 2>/dev/null || true)}}
    uv_install --requirement pyproject.toml ${extra:+--extra "$extra"} pip || return 1
    # Building the project's own metadata takes longer than all the rest: once for all extras is enough.
    cat .venv/installed* 2>/dev/null | grep -qxF "$wanted" || uv_install --no-deps --editable .
}

uv_install() {
    .venv/bin/uv pip install --quiet --native-tls ${index:+--default-index "$index"} --python .venv/bin/python \
        --constraint constraints.txt "$@"
}

# The pip of the Python beneath installs uv. Where it has none, the environment gets its own, which takes ten seconds.
get_uv() {
    "$beneath" -m pip --python .venv/bin/python install --quiet --constraint constraints.txt uv 2>/dev/null ||
        { own_pip && .venv/bin/python -m pip install --quiet --constraint constraints.txt uv; }
}

own_pip() { has_pip || .venv/bin/python -m ensurepip >/dev/null; }

# Python compiles the modules that are used when they are first imported: pip would compile all of them, 20 seconds.
by_pip() {
    own_pip || return 1
    .venv/bin/python -m pip install --quiet --no-compile --constraint constraints.txt \
        --editable ".${extra:+[$extra]}"
}

whole || make_venv
[ "$(cat "$stamp" 2>/dev/null)" != "$wanted" ] || exit 0
install
if ! usable; then
    say ".venv is damaged and is made again"
    make_venv
    install
    usable || {
        say "what was installed does not work:"
        .venv/bin/python -c 'import wavefocus, numpy, scipy.fft, h5py, pydantic, rich, matplotlib, jinja2, soundfile'
        exit 1
    }
fi
echo "$wanted" >"$stamp"
