//! Barchan's sand: [`Sand`].

mod sand;

pub use sand::Sand;

use barchan_material_kit::{BarchanMaterial, vtable};

/// The tables of this crate's materials.
pub fn materials() -> Vec<&'static BarchanMaterial> {
    vec![vtable::<Sand>()]
}
