//! Barchan's liquid: [`Liquid`].

mod liquid;

pub use liquid::Liquid;

use barchan_material_kit::{BarchanMaterial, vtable};

/// The tables of this crate's materials.
pub fn materials() -> Vec<&'static BarchanMaterial> {
    vec![vtable::<Liquid>()]
}
