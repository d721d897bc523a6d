//! Prints what an update of the elastic materials costs, in nanoseconds a particle.
#![expect(unsafe_code, reason = "a table is trusted to obey the ABI")]

use barchan_material_kit::{Subject, timing::ns_per_particle};

fn main() {
    for table in barchan_elastic::materials() {
        // SAFETY: the table comes from `vtable`.
        let subject = unsafe { Subject::new(table) }.expect("a table of this version");
        let params = subject.default_params();
        let particle = subject.particle_at_rest();
        println!("{} near rest: {:.2} ns", subject.name(), ns_per_particle(&subject, &params, &particle));
        let mut strained = particle;
        strained.strain.iter_mut().for_each(|x| *x *= 0.8);
        println!("{} at stretch 0.8: {:.2} ns", subject.name(), ns_per_particle(&subject, &params, &strained));
    }
}
