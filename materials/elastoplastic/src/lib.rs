//! Barchan's elastoplastic materials: [`VonMises`].

mod von_mises;

pub use von_mises::VonMises;

use barchan_material_kit::{BarchanMaterial, vtable};

/// The tables of this crate's materials.
pub fn materials() -> Vec<&'static BarchanMaterial> {
    vec![vtable::<VonMises>()]
}
