//! The conformance suite on this crate's materials.
#![expect(unsafe_code, reason = "a table is trusted to obey the ABI")]

use barchan_material_kit::{Subject, conformance};

#[test]
fn every_material_conforms() {
    for table in barchan_snow::materials() {
        // SAFETY: the table comes from `vtable`.
        let subject = unsafe { Subject::new(table) }.expect("a table of this version");
        match conformance::run_all(&subject, &subject.default_params()) {
            Ok(measured) => measured.iter().for_each(|m| println!("{}: {m}", subject.name())),
            Err(violation) => panic!("{violation}"),
        }
    }
}
