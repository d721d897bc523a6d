#!/usr/bin/env bash
# Builds the wheel, installs it into a virtual environment of its own and tests it there. Arguments go to pytest.
#
#     bash bindings/python/test.sh [-k NAME ...]
#
# The environment is target/venv (or $CARGO_TARGET_DIR/venv): about 50 MB are fetched from PyPI, 300 MB lie there. Needs Python 3.10 or newer with venv, which
# tests/robots/fetch.sh installs, and a C compiler. The first build takes nine minutes of one core, the tests a quarter of a minute.
set -euo pipefail
here="$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)"
requirements="$here/tests/requirements.txt"
cd "$here/../.."
target="${CARGO_TARGET_DIR:-target}"
mkdir -p "$target"
target="$(cd "$target" && pwd)"
venv="$target/venv"

if ! cmp -s "$requirements" "$venv/installed.txt"; then
    echo "Installing maturin, NumPy, matplotlib and pytest into $venv (about 50 MB)."
    python3 -m venv --clear "$venv"
    "$venv/bin/python" -m pip install --quiet --disable-pip-version-check --only-binary :all: --requirement "$requirements"
    cp "$requirements" "$venv/installed.txt"
fi

# Optimised as the other tests are: the physics would be slow otherwise.
rm -rf "$target/wheels-for-tests"
CARGO_PROFILE_DEV_OPT_LEVEL=3 "$venv/bin/maturin" build --quiet --locked --profile dev --strip --manifest-path "$here/Cargo.toml" \
    --interpreter "$venv/bin/python" --out "$target/wheels-for-tests"
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check --no-deps --no-index --force-reinstall "$target"/wheels-for-tests/*.whl
cd "$here"
# From here the installed package is found, not its sources.
exec "$venv/bin/python" -m pytest -q -p no:cacheprovider "$@"
