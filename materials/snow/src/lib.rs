//! Barchan's snow: [`Snow`].

mod snow;

pub use snow::Snow;

use barchan_material_kit::{BarchanMaterial, vtable};

/// The tables of this crate's materials.
pub fn materials() -> Vec<&'static BarchanMaterial> {
    vec![vtable::<Snow>()]
}
