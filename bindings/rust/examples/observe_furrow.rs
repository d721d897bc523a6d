//! An observer of one's own: the depth of the furrow that a ball draws through sand, as a column of the trace and as profiles in files.
//!
//! `cargo run --release -p barchan --example observe_furrow`

use barchan::run::{Existing, Request, Until, run, run_with};
use barchan::scene::{Body, MaterialSpec, Shape, Tool, Wall, World};
use barchan::{Observer, Options, Output, Result, Scene, Simulation};
use std::fmt::Write;
use std::ops::ControlFlow;
use std::path::Path;

const SURFACE: f64 = 0.1;

/// Looks every 20 ms at how deep the sand lies along the middle.
struct Furrow {
    depths: Vec<f64>,
}

impl Observer for Furrow {
    fn name(&self) -> &str {
        "furrow"
    }
    fn interval(&self) -> f64 {
        0.02
    }
    fn columns(&self) -> Vec<String> {
        vec!["depth [m]".to_owned()]
    }
    fn observe(&mut self, simulation: &Simulation, output: &mut dyn Output) -> Result<()> {
        let mut heights = [0.0f64; 20];
        for spot in simulation.spots().iter().filter(|spot| (spot.position[1] - 0.1).abs() < 0.01) {
            let column = ((spot.position[0] / 0.02) as usize).min(19);
            heights[column] = heights[column].max(spot.position[2] + 0.5 * spot.side());
        }
        // Where the ball comes by later.
        let depth = SURFACE - heights[10..12].iter().copied().fold(SURFACE, f64::min);
        output.set(0, depth);
        let mut csv = String::from("x [m],height [m]\n");
        for (i, height) in heights.iter().enumerate() {
            let _ = writeln!(csv, "{},{height}", 0.02 * (i as f64 + 0.5));
        }
        let path = output.file(&format!("profile-{:02}.csv", self.depths.len()))?;
        std::fs::write(&path, csv).map_err(|source| barchan::Error::Io {
            file: path,
            what: "writing a profile",
            source,
        })?;
        self.depths.push(depth);
        Ok(())
    }
}

fn scene() -> Scene {
    let world = World::new(0.02, [0.0; 3], [0.4, 0.2, 0.2]).with_walls(Wall::Slip);
    let mut scene = Scene::new("furrow", world, 0.2)
        .with(MaterialSpec::new("sand", "sand", 1600.0).with("young_modulus", 1e5))
        .with(Body::new("sand", Shape::cuboid([0.0; 3], [0.4, 0.2, SURFACE])))
        .with(Tool::new("ball", Shape::sphere(0.04)).at([0.1, 0.1, 0.12]).driven([0.8, 0.0, 0.0]));
    scene.output.picture.on = false;
    scene
}

fn simulated(out: &Path, observers: &mut [&mut dyn Observer]) -> Result<Simulation> {
    let mut simulation = Simulation::new(&barchan::registry(), &scene(), &Options::default())?;
    let until = Until::Time(simulation.plan().scene.time.end);
    let existing = Existing::Overwrite;
    let request = Request { out: out.to_owned(), until, pictures: false, export: None, existing, swap: None };
    let mut go_on = |_: &_| ControlFlow::Continue(());
    match observers {
        [] => run(&mut simulation, &request, &mut go_on)?,
        all => run_with(&mut simulation, &request, all, &mut go_on)?,
    };
    Ok(simulation)
}

fn main() -> Result<()> {
    let out = std::env::temp_dir().join(format!("barchan-furrow-{}", std::process::id()));
    let mut furrow = Furrow { depths: Vec::new() };
    let observed = simulated(&out.join("observed"), &mut [&mut furrow])?;
    println!("depth of the furrow every 20 ms: {:.3?} m", furrow.depths);

    // At the start, and after the first step past each multiple of 20 ms.
    assert_eq!(furrow.depths.len(), 11);
    assert!(furrow.depths[10] > furrow.depths[0] + 0.01, "the ball leaves no furrow");
    let trace = std::fs::read_to_string(out.join("observed/trace.csv")).unwrap_or_default();
    assert!(trace.lines().next().is_some_and(|head| head.ends_with(",furrow depth [m]")), "no column in the trace");
    let last = trace.lines().last().and_then(|row| row.rsplit(',').next()?.parse::<f64>().ok());
    assert_eq!(last, furrow.depths.last().copied());
    assert!(out.join("observed/observed/furrow/profile-10.csv").is_file());

    // Looking changes no bit of what is simulated.
    let alone = simulated(&out.join("alone"), &mut [])?;
    assert_eq!(observed.particles(), alone.particles());
    let _ = std::fs::remove_dir_all(&out);
    Ok(())
}
