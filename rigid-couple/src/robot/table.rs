//! A robot as a table, for people.

use super::model::{Freedom, RobotModel};
use crate::sdf::Primitive;
use std::fmt;

impl fmt::Display for RobotModel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let solid = self.links.iter().filter(|link| link.mass > 0.0).count();
        writeln!(
            f,
            "{}: {:.3} kg, {} links ({solid} with mass), {} joints that can be driven\n",
            self.name,
            self.mass(),
            self.links.len(),
            self.drives.len()
        )?;
        writeln!(f, "{:<26} {:>9}  {:<24} collision shapes", "link", "mass [kg]", "joint to its parent")?;
        for link in &self.links {
            let joint = match (link.parent, link.joint.freedom) {
                (None, _) => "base".to_owned(),
                (_, Freedom::Fixed) => format!("{} (fixed)", link.joint.name),
                _ if link.joint.name != self.drives[link.joint.drive].name => {
                    format!("{} (follows {})", link.joint.name, self.drives[link.joint.drive].name)
                }
                _ => link.joint.name.clone(),
            };
            let shapes: Vec<&str> = link
                .shape
                .iter()
                .flat_map(|shape| shape.parts())
                .map(|p| name(&p.primitive, self.collision_meshes.are_exact(&link.name)))
                .collect();
            writeln!(f, "{:<26} {:>9.4}  {joint:<24} {}", link.name, link.mass, shapes.join(", "))?;
        }
        writeln!(
            f,
            "\n{:<26} {:>9} {:>9} {:>9} {:>9} {:>9} {:>9}",
            "joint", "least", "greatest", "effort", "speed", "damping", "friction"
        )?;
        let number = |x: f64| if x.is_finite() { format!("{x:.4}") } else { "none".to_owned() };
        for drive in &self.drives {
            let [least, greatest] = drive.limits.map(number);
            let unit = if drive.turns { "rad, N m" } else { "m, N" };
            writeln!(
                f,
                "{:<26} {least:>9} {greatest:>9} {:>9} {:>9} {:>9} {:>9}  {unit}",
                drive.name,
                number(drive.effort),
                number(drive.speed),
                number(drive.damping),
                number(drive.friction)
            )?;
        }
        self.warnings.iter().try_for_each(|warning| writeln!(f, "\nwarning: {warning}"))
    }
}

fn name(primitive: &Primitive, is_exact: bool) -> &'static str {
    match primitive {
        Primitive::Sphere { .. } => "sphere",
        Primitive::Box { .. } => "box",
        Primitive::Cylinder { .. } => "cylinder",
        Primitive::Capsule { .. } => "capsule",
        Primitive::Plane => "plane",
        Primitive::HeightField(_) => "height field",
        Primitive::Mesh(_) if is_exact => "mesh",
        Primitive::Mesh(_) => "mesh (hull)",
    }
}
