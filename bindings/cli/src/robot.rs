//! `barchan robot`.

use crate::print::show;
use barchan::picture::draw_robot;
use barchan::scene::CollisionMeshes;
use barchan::{Error, Result, RobotModel};
use clap::{Args, Subcommand};
use std::path::PathBuf;

/// Columns of a picture.
const PIXELS: usize = 960;

#[derive(Subcommand)]
pub(crate) enum Robot {
    /// Reads a robot as a scene would, and prints its links, masses, joints and shapes, or what is wrong and where; draws it, if asked.
    Check(CheckArgs),
}

#[derive(Args)]
pub(crate) struct CheckArgs {
    /// A URDF file, or a robot that is built in: quadruped, humanoid, arm, arm-rod, arm-shovel, arm-scraper.
    robot: String,
    /// Draws the robot there, too, as its visual elements show it: a PNG, 960 pixels wide.
    #[arg(long, value_name = "PNG")]
    out: Option<PathBuf>,
    /// Mend inertias that no body has, as `mend_inertias` does in a scene, instead of refusing them.
    #[arg(long)]
    mend_inertias: bool,
    /// Take collision meshes as they are, as `collision_meshes` does in a scene, instead of their convex hulls: all, or those of some links, such as --exact-meshes=bucket*,fork.
    #[arg(long, value_name = "LINKS", value_delimiter = ',', num_args = 0.., require_equals = true)]
    exact_meshes: Option<Vec<String>>,
}

pub(crate) fn run(command: &Robot) -> Result<()> {
    let Robot::Check(args) = command;
    let is_file = args.robot.contains(['.', '/', '\\']);
    let mut robot = match is_file {
        true => barchan::scene::Robot::from_urdf("robot", &args.robot),
        false => barchan::scene::Robot::built_in("robot", args.robot.as_str()),
    };
    robot.mend_inertias = args.mend_inertias;
    if let Some(links) = &args.exact_meshes {
        robot.collision_meshes = match &links[..] {
            [] => CollisionMeshes::Exact,
            links => CollisionMeshes::ExactLinks(links.to_vec()),
        };
    }
    let model = RobotModel::of(&robot, std::path::Path::new(""))
        .map_err(|refusal| -> Error { refusal.at(&format!("robot '{}'", args.robot)) })?;
    show(&model);
    let Some(file) = &args.out else { return Ok(()) };
    let drawn = draw_robot(&model, PIXELS).write_png(file, &[("Title", &model.name)]);
    drawn.map_err(|source| Error::Io { file: file.clone(), what: "writing the picture", source })
}
