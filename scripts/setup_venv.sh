#!/bin/sh
# Make .venv where there is none and install torchlb into it, editable, with one extra: setup_venv.sh EXTRA
# From the environment, each may be empty: PYTHON, an interpreter; TORCH, a requirement; TORCH_INDEX, its index.
set -eu
cd "$(dirname "$0")/.."
extra=${1:?usage: setup_venv.sh EXTRA}
python=.venv/bin/python

# A command of that name may exist and still not run (a version manager's stub), so each candidate is tried.
is_recent() {
    "$1" -c 'import sys, venv; sys.exit(sys.version_info < (3, 10))' >/dev/null 2>&1
}

base_python() {
    for candidate in "${PYTHON:-python3}" python3.13 python3.12 python3.11 python3.10 python; do
        if is_recent "$candidate"; then
            echo "$candidate"
            return
        elif [ -n "${PYTHON:-}" ]; then
            echo "PYTHON=$PYTHON is not a Python >= 3.10 that can make a virtual environment" >&2
            return 1
        fi
    done
    echo "found no Python >= 3.10 that can make a virtual environment; name one with PYTHON=path" >&2
    return 1
}

if ! is_recent "$python"; then
    base=$(base_python)
    echo "making .venv with $("$base" --version)"
    "$base" -m venv --clear --without-pip .venv
fi

# Some systems ship Python without ensurepip; there the pip beside that Python fills .venv.
if ! "$python" -m pip --version >/dev/null 2>&1; then
    if "$python" -c 'import ensurepip' >/dev/null 2>&1; then
        "$python" -m ensurepip --default-pip >/dev/null
    else
        base=$(base_python)
        "$base" -m pip --python "$python" install --quiet pip
    fi
fi

# torch comes first and apart: the newest one on an index is often a CUDA build of several gigabytes.
if ! "$python" -c 'import torch' >/dev/null 2>&1; then
    echo "installing ${TORCH:=torch==2.13.0}"
    if [ -n "${TORCH_INDEX:-}" ]; then
        "$python" -m pip install --quiet --index-url "$TORCH_INDEX" "$TORCH"
    else
        "$python" -m pip install --quiet "$TORCH"
    fi
fi

echo "installing torchlb[$extra]"
"$python" -m pip install --quiet --editable ".[$extra]"

# Numba keeps what it compiles beside the source.
"$python" -c 'import torchlb.linalg.kernels'
