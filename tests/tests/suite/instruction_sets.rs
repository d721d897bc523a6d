//! What holds with the machine's best instruction set holds with each that it has.

use barchan_lanes::Isa;
use std::env;
use std::process::Command;

/// Material conformance, transfers, determinism and kept states again with every other instruction set, baseline included: each in a process of its
/// own, since a process keeps the set that it began with. Lanes' own tests go through all of them as they are.
#[test]
fn kernels_hold_on_every_instruction_set() {
    let current = Isa::current().unwrap();
    for isa in Isa::available().filter(|isa| *isa != current) {
        let output = Command::new(env::current_exe().unwrap())
            .env("BARCHAN_ISA", isa.name())
            .args(["conformance::", "transfers::", "determinism::", "goldens::"])
            .output()
            .unwrap();
        let text = String::from_utf8_lossy(&output.stdout);
        assert!(output.status.success(), "with {}:\n{text}", isa.name());
        for module in ["conformance", "transfers", "determinism", "goldens"] {
            assert!(text.contains(&format!("test {module}::")), "with {} none of {module} ran:\n{text}", isa.name());
        }
    }
}
