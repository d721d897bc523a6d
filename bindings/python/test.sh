#!/usr/bin/env bash
# Builds the wheel, installs it into a virtual environment of its own and tests it there. Other arguments go to pytest.
#
#     bash bindings/python/test.sh [--learn] [-k NAME ...]
#
# The environment is target/venv (or $CARGO_TARGET_DIR/venv): about 100 MB are fetched from PyPI, 450 MB lie there. Needs Python 3.10 or newer with venv, which
# tests/robots/fetch.sh installs, and a C compiler. The first build takes nine minutes of one core, the tests two minutes.
#
# --learn tests the extra [learn] instead, in target/venv-learn: Stable-Baselines3 needs PyTorch, of which 0.6 GB are fetched, and 1.6 GB lie there.
set -euo pipefail
here="$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)"
requirements="$here/tests/requirements.txt"
cd "$here/../.."
target="${CARGO_TARGET_DIR:-target}"
mkdir -p "$target"
target="$(cd "$target" && pwd)"
venv="$target/venv"
wanted="$(cat "$requirements")"
marked=(-m "not learn")
if [ "${1:-}" = "--learn" ]; then
    shift
    venv="$target/venv-learn"
    wanted="$wanted$(cat "$here/tests/requirements-learn.txt")"
    marked=(-m learn)
fi

if [ "$wanted" != "$(cat "$venv/installed.txt" 2>/dev/null)" ]; then
    echo "Installing what the tests need into $venv."
    python3 -m venv --clear "$venv"
    install=("$venv/bin/python" -m pip install --quiet --disable-pip-version-check --only-binary :all:)
    "${install[@]}" --requirement "$requirements"
    if [ "${marked[1]}" = learn ]; then
        "${install[@]}" --no-deps --requirement "$here/tests/requirements-learn.txt"
        "$venv/bin/python" "$here/tests/small_torch.py" "$("$venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("platlib"))')"
    fi
    printf '%s\n' "$wanted" >"$venv/installed.txt"
fi

# Optimised as the other tests are, for the physics would be slow otherwise, and of what has been built for them if they ran before. For Python itself, so that
# both environments share what is built.
rm -rf "$target/wheels-for-tests"
"$venv/bin/maturin" build --quiet --locked --profile dev --strip --features as-for-tests --manifest-path "$here/Cargo.toml" \
    --interpreter "$(python3 -c 'import sys; print(sys.executable)')" --out "$target/wheels-for-tests"
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check --no-deps --no-index --force-reinstall "$target"/wheels-for-tests/*.whl
cd "$here"
# From here the installed package is found, not its sources.
exec "$venv/bin/python" -m pytest -q -p no:cacheprovider "${marked[@]}" "$@"
