//! Prints what an update of sand costs near rest (series) and far from it (eigen-decomposition), in nanoseconds a particle.
#![expect(unsafe_code, reason = "a table is trusted to obey the ABI")]

use barchan_material_kit::{Subject, timing::ns_per_particle};

fn main() {
    for table in barchan_sand::materials() {
        // SAFETY: the table comes from `vtable`.
        let subject = unsafe { Subject::new(table) }.expect("a table of this version");
        let params = subject.default_params();
        let rest = subject.particle_at_rest();
        for (name, strain) in [
            ("elastic, near", [0.998, 0.998, 0.997, 1e-4, 2e-4, 0.0, 0.0, 0.0, 0.0]),
            ("yielding, near", [0.998, 0.998, 0.997, 1e-2, 2e-4, 0.0, 0.0, 0.0, 0.0]),
            ("elastic, far", [0.7, 0.75, 0.72, 1e-2, 2e-2, 0.0, 0.0, 0.0, 0.0]),
            ("yielding, far", [0.7, 0.9, 1.1, 0.1, 0.2, 0.1, 0.0, 0.0, 0.0]),
        ] {
            let mut particle = rest;
            particle.strain = strain;
            println!("{} {name}: {:.2} ns", subject.name(), ns_per_particle(&subject, &params, &particle));
        }
    }
}
