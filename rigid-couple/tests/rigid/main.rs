//! Rigid tools and bodies against closed forms and conservation laws, without a grid: nodes are made up here.

mod bodies;
mod contact;
mod motion;
mod sdf;

use barchan_core::contact::Contact;
use barchan_core::{Coupling, NearParticle, NodeBatch, Scene};
use barchan_rigid::Rigid;
use glam::DVec3;

/// A scene around `tools`, in an open world without gravity.
fn scene(tools: &str) -> Scene {
    world(tools, "", [0.0; 3])
}

fn world(tools: &str, walls: &str, gravity: [f64; 3]) -> Scene {
    let text = format!(
        "name = 'test'\ngravity = {gravity:?}\nworld = {{ cell = 0.01, min = [-1, -1, -1], max = [1, 1, 1], walls = {{ {walls} }} }}\ntime = {{ end = 1.0 }}\n{tools}"
    );
    toml::from_str(&text).unwrap_or_else(|e| panic!("{e}\n{text}"))
}

fn rigid(tools: &str) -> Rigid {
    Rigid::new(&scene(tools)).unwrap()
}

/// The message with which a scene's tools are refused.
fn refusal(tools: &str) -> String {
    Rigid::new(&scene(tools)).err().map_or_else(|| panic!("accepted: {tools}"), |e| e.to_string())
}

/// Nodes, and on each a particle so small that it is inside a body or outside, and so stiff that what it presses with bounds nothing.
fn batch(nodes: &[([f64; 3], f64, [f64; 3])]) -> NodeBatch {
    let particle = |(cube, node): (u32, &([f64; 3], f64, [f64; 3]))| NearParticle {
        cube,
        position: node.0,
        place: [0.0; 3],
        volume: 1e-27,
        modulus: 1e40,
    };
    let around = |node: u32| std::array::from_fn(|n| if n == 0 { node } else { NodeBatch::NONE });
    NodeBatch {
        particles: (0..).zip(nodes).map(particle).collect(),
        cubes: (0..nodes.len() as u32).map(around).collect(),
        cell_width: 0.01,
        periods: [0.0; 3],
        position: nodes.iter().map(|n| n.0).collect(),
        mass: nodes.iter().map(|n| n.1).collect(),
        velocity: nodes.iter().map(|n| n.2).collect(),
    }
}

fn step(coupling: &mut impl Coupling, time: f64, dt: f64, nodes: &mut NodeBatch) {
    coupling.before_step(time, dt).unwrap();
    meet(coupling, dt, nodes).unwrap();
    coupling.after_step(time, dt).unwrap();
}

fn meet(coupling: &mut impl Coupling, dt: f64, nodes: &mut NodeBatch) -> barchan_core::Result<()> {
    Contact::default().meet(&mut [coupling], dt, nodes)
}

fn momentum(nodes: &NodeBatch) -> DVec3 {
    (0..nodes.len()).map(|i| nodes.mass[i] * DVec3::from_array(nodes.velocity[i])).sum()
}

fn angular_momentum(nodes: &NodeBatch) -> DVec3 {
    let at =
        |i: usize| DVec3::from_array(nodes.position[i]).cross(nodes.mass[i] * DVec3::from_array(nodes.velocity[i]));
    (0..nodes.len()).map(at).sum()
}

fn energy(nodes: &NodeBatch) -> f64 {
    (0..nodes.len()).map(|i| 0.5 * nodes.mass[i] * DVec3::from_array(nodes.velocity[i]).length_squared()).sum()
}

/// Prints the measured error beside the tolerance, and holds one to the other.
#[track_caller]
fn within(what: &str, error: f64, tolerance: f64) {
    println!("{what}: {error:.3e} (tolerance {tolerance:.1e})");
    assert!(error <= tolerance, "{what}: {error:e} > {tolerance:e}");
}

/// Numbers between −1 and 1, the same in every run (SplitMix64).
struct Random(u64);

impl Random {
    fn number(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z ^ (z >> 31)) as f64 / 2f64.powi(63) - 1.0
    }
    fn vector(&mut self) -> DVec3 {
        DVec3::new(self.number(), self.number(), self.number())
    }
}
