//! Stress of particles as they are.
#![expect(unsafe_code, reason = "a law that fails is written against the C ABI")]

use barchan::plan::PlannedMaterial;
use barchan::stress::kirchhoff;
use barchan::{Error, ParticleList};
use barchan_abi::{BARCHAN_E_OTHER, BarchanBatchF64, BarchanError, BarchanStatus};

/// Fails, and blames a particle that is not in the batch.
unsafe extern "C" fn blame(_: *const BarchanBatchF64, error: *mut BarchanError) -> BarchanStatus {
    // SAFETY: the host hands over an error struct.
    unsafe { (*error).particle = 1 << 40 };
    BARCHAN_E_OTHER
}

/// Symptom: a law whose update blames a particle beyond the batch ended the program while a picture was drawn. It is an error that names none.
#[test]
fn a_law_that_blames_a_particle_beyond_the_batch_is_an_error() {
    let mut material = barchan::registry().material("neo_hookean").unwrap().clone();
    material.table.update_f64 = Some(blame);
    let parameters = material.parameters.iter().filter_map(|parameter| parameter.default_number()).collect();
    let planned = PlannedMaterial { name: "m".into(), material, parameters, density: 1000.0, damping: None };
    let identity = planned.material.strain_identity();
    let list = ParticleList { id: vec![7; 3], ..ParticleList::empty(0, 0, 0.1, identity.len(), 0) };
    let list = ParticleList { strain: identity.iter().map(|one| vec![*one; 3]).collect(), ..list };
    let error = kirchhoff(&planned, &list, &[0, 2]).unwrap_err();
    assert!(matches!(error, Error::MaterialFailed { particle: None, .. }), "{error}");
}
