//! The conformance suite on this crate's materials.
#![expect(unsafe_code, reason = "a table is trusted to obey the ABI")]

use barchan_material_kit::{Subject, conformance};

#[test]
fn every_material_conforms() {
    for table in barchan_elastic::materials() {
        // SAFETY: the table comes from `vtable`.
        let subject = unsafe { Subject::new(table) }.expect("a table of this version");
        let samples = conformance::samples(&subject, 16, 1);
        assert_eq!(samples.len(), 16, "{} refuses nearly all of its declared ranges", subject.name());
        let findings = conformance::survey(&subject, &samples, &mut |_, _| ());
        findings.iter().for_each(|finding| println!("{}: {finding}", subject.name()));
        let failed: Vec<_> = findings.iter().filter(|finding| finding.is_failure()).collect();
        assert!(failed.is_empty(), "{} fails {} checks", subject.name(), failed.len());
    }
}
