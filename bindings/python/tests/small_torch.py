"""Lets PyTorch as PyPI has it be imported without CUDA's libraries, which it asks for and the tests never call: empty ones take their place.

    python small_torch.py SITE_PACKAGES

For tests only. It needs a C compiler and nm.
"""

import collections
import subprocess
import sys
import tempfile
from pathlib import Path

VERSIONED = ("libcublas", "libcudnn", "libcusparse", "libcufft", "libnvrtc", "libcusolver")
"""Libraries whose symbols say which one they are from."""

folder = Path(sys.argv[1]) / "torch" / "lib"
wanted: dict[str, set[tuple[str, str]]] = collections.defaultdict(set)
for library in folder.glob("*.so"):
    listed = subprocess.run(["nm", "-D", "--undefined-only", library], capture_output=True, text=True, check=True)
    for line in listed.stdout.splitlines():
        name, _, version = line.split()[-1].partition("@")
        version = version.lstrip("@")
        if version.startswith(VERSIONED):
            wanted[version].add((name, version))
        elif name.startswith("cusparseLt"):
            wanted["libcusparseLt.so.0"].add((name, ""))
        elif name.startswith("nccl"):
            wanted["libnccl.so.2"].add((name, ""))
        elif "nvshmem" in name:
            wanted["libnvshmem_host.so.3"].add((name, version))
with tempfile.TemporaryDirectory() as temporary:
    source, versions = Path(temporary) / "empty.c", Path(temporary) / "versions.map"
    for library, symbols in wanted.items():
        source.write_text("\n".join(f"int {name}(void) {{ return 1; }}" for name, _ in sorted(symbols)))
        command = ["cc", "-shared", "-fPIC", "-w", "-o", folder / library, source, f"-Wl,-soname,{library}"]
        named = sorted(version for _, version in symbols if version)
        if named:
            versions.write_text(f"{named[0]} {{ global: *; }};")
            command.append(f"-Wl,--version-script,{versions}")
        subprocess.run(command, check=True)
