#!/usr/bin/env bash
# Installs the robots that the tests load (URDF files and meshes of the PyPI package example-robot-data) and prints their folder as its last line.
#
#     bash tests/robots/fetch.sh
#
# Puts them into target/robots (or $CARGO_TARGET_DIR/robots): 131 MB are fetched, 431 MB lie there. Does nothing where they are already.
# Needs Python 3.9 or newer with venv; on Linux with apt-get, as root, it installs that. The version and its hash stand in requirements.txt.
set -euo pipefail
here="$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)"
requirements="$here/requirements.txt"

stop() { printf '\n%s\n' "$*" >&2; exit 1; }

# As cargo does, from the root of the repository.
cd "$here/../.."
venv="${CARGO_TARGET_DIR:-target}/robots"
mkdir -p "$venv"
venv="$(cd "$venv" && pwd)"
package="$venv/example-robot-data" # package:// addresses resolve against $venv
robots="$package/robots"

# Written last, so what was interrupted is done anew.
if cmp -s "$requirements" "$venv/installed.txt" && [ -f "$robots/go2_description/urdf/go2.urdf" ]; then
    echo "The robots of $(cut -d' ' -f1 "$requirements") are there."
    echo "$robots"
    exit 0
fi

command -v python3 >/dev/null || stop "python3 is missing: it fetches the robots that the tests load. Install it, then run this script again."
if ! python3 -c 'import venv, ensurepip' 2>/dev/null; then
    install="apt-get install -y --no-install-recommends python3-venv"
    command -v apt-get >/dev/null || stop "Python's venv is missing. Install your distribution's package of it, then run this script again."
    [ "$(id -u)" -eq 0 ] || stop "Python's venv is missing. Run this line (about 10 MB), then this script again:
    sudo apt-get update && sudo $install"
    echo "Installing python3-venv (about 10 MB)."
    apt-get update && $install
fi

echo "Fetching $(cut -d' ' -f1 "$requirements") into $venv (131 MB to fetch, 431 MB on the disk)."
rm -f "$venv/installed.txt"
python3 -m venv --clear "$venv"
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check --no-deps --no-compile --no-cache-dir --only-binary :all: --require-hashes \
    --requirement "$requirements" || stop "The robots that the tests load could not be fetched: see pip's lines above.
Without a network, copy $venv from a machine that has it, or point pip at a copy of the wheel with PIP_NO_INDEX=1 PIP_FIND_LINKS=FOLDER.
Then run this script again:
    bash tests/robots/fetch.sh"

# The wheel puts its files here; a link keeps the tests from knowing Python's version.
found="$("$venv/bin/python" -c 'import sys; print("lib/python%d.%d" % sys.version_info[:2])')/site-packages/cmeel.prefix/share/example-robot-data"
ln -sfn "$found" "$package"
[ -f "$robots/go2_description/urdf/go2.urdf" ] || stop "The package was installed, but its robots are not in $venv/$found."
cp "$requirements" "$venv/installed.txt"
echo "$robots"
