//! Free bodies, which the device moves by itself as long as they meet nothing but the ground.

use super::{apart, cpu, gpu, off, passes_of, take_at_once};
use barchan::{Simulation, Vec3};
use barchan_tests::scenes::{norm, rows, scene, within};
use barchan_tests::sketch::{Head, block, body, half, material, tool};
use barchan_wgpu::Wgpu;
use barchan_wgpu::device::Offer;

const FRICTION: &str = "{ coulomb = { friction = 0.4 } }";

/// In how many steps the device moved free bodies, those in vain behind a stop among them, and in how many the host did.
fn steps_on_device_and_host(sim: &Simulation) -> [u64; 2] {
    [passes_of(sim, "answering bodies") + passes_of(sim, "answering bodies, rims"), passes_of(sim, "contact")]
}

/// A spinning ball of jelly that strikes a box of that mass [kg] in free space.
fn collision(contact: &str, mass: f64) -> String {
    let ball = "sphere = { center = [-0.36, 0.06, 0.02], radius = 0.2 }";
    Head::space(0.05).time("step = 1e-3").with(&[
        material("neo_hookean", 1000.0, "young_modulus = 1e5, poisson_ratio = 0.3"),
        body("neo_hookean", ball, "velocity = [1.5, 0.2, 0.0]\nangular_velocity = [0.0, 0.0, 2.0]"),
        tool("box", [0.0; 3], &half([0.15, 0.2, 0.2]), contact, &format!("{{ free = {{ mass = {mass} }} }}")),
    ])
}

/// Whatever the masses and the contact, a free body gets exactly what the ground loses, and goes where it goes on the CPU; all of that on the
/// device, without a step on the host. The ball has 33 kg.
#[test]
fn a_free_body_gets_what_the_ground_loses() {
    for (contact, mass) in [(FRICTION, 8.0), ("\"slip\"", 30.0), ("\"stick\"", 0.03), (FRICTION, 3e4), (FRICTION, 0.1)]
    {
        let toml = collision(contact, mass);
        let (mut g, mut c) = (gpu(&toml), cpu(&toml));
        let before = g.ledger();
        let momentum = norm(before.momentum);
        let steps = 110;
        take_at_once(&mut g, steps);
        (0..steps).for_each(|_| drop(c.step().unwrap()));
        let (after, there) = (g.ledger(), c.ledger());
        println!("{contact}, {mass} kg: {:?}\n{:?}", g.bodies()[0], c.bodies()[0]);
        let [on_device, on_host] = steps_on_device_and_host(&g);
        assert!(on_device >= steps as u64 && on_host == 0, "{on_device} {on_host}");
        assert!(norm(after.body_momentum) > 1e-4 * momentum, "they never met");
        let total = |l: &barchan::Ledger| -> Vec3 { std::array::from_fn(|d| l.momentum[d] + l.body_momentum[d]) };
        let turning = |l: &barchan::Ledger| -> Vec3 {
            std::array::from_fn(|d| l.angular_momentum[d] + l.body_angular_momentum[d])
        };
        within("momentum, relative", off(total(&after), total(&before)) / momentum, 2e-6);
        within("angular momentum, relative", off(turning(&after), turning(&before)) / (0.4 * momentum), 5e-6);
        let energy = after.kinetic + after.elastic + after.body_kinetic;
        within("energy, over that at the start", energy / before.kinetic, 1.001);
        within(
            "place of the box beside the CPU's, in cells",
            off(g.bodies()[0].position, c.bodies()[0].position) / 0.05,
            1e-3,
        );
        let exchanged = off(after.body_momentum, there.body_momentum) / norm(there.body_momentum);
        within("momentum of the box beside the CPU's, relative", exchanged, 1e-3);
        let counted = |ledger: &barchan::Ledger, name: &str| ledger.counts.get(name).copied().unwrap_or(0);
        let unconverged = counted(&after, "contact solutions of free bodies not converged");
        within("solutions that did not converge", unconverged as f64, 0.0);
        // Nodes far inside the box that weigh nothing do not count.
        let deep = "nodes deeper than two cells inside a rigid body";
        assert_eq!(counted(&after, deep), counted(&there, deep), "{contact}, {mass} kg");
    }
}

/// A cube that drops into sand and slides, with levels and steps of their own or without, followed by them or on coarse ground: where it comes to is
/// where it comes to on the CPU, and the same bits come of many steps at once and of single ones. Levels that follow it keep coarser ones
/// away from it, which are not asked about it then.
#[test]
fn a_cube_slides_on_sand_as_on_the_cpu() {
    let h = 0.02;
    let walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"";
    let levels = |agent: &str, more: &str| format!("[levels]\ncount = 2\nhalf = 8\nagents = [\"{agent}\"]\n{more}");
    let cases = [
        (String::new(), 2.5e-4),
        (levels("cube", ""), 2.5e-4),
        (levels("cube", "subcycle = true\n"), 5e-4),
        (levels("ball", "subcycle = true\n"), 5e-4),
    ];
    for (levels, step) in cases {
        let is_coarse = levels.contains("ball");
        // In the air. What acts on coarse ground reaches further, and keeps further off walls.
        let (cells, top, y, ball) = if is_coarse {
            let free = "{ free = { mass = 0.1 } }";
            ([32, 24, 20], 0.16, 0.24, tool("ball", [0.5, 0.36, 0.3], "sphere = { radius = 0.02 }", FRICTION, free))
        } else {
            ([32, 16, 16], 0.1, 0.16, String::new())
        };
        let head = Head::cells(h, cells, walls).time(format!("step = {step}"));
        let toml = head.with(&[
            material("sand", 1500.0, "young_modulus = 2e5, poisson_ratio = 0.2, friction_angle_deg = 35"),
            block("sand", [0.0; 3], [0.64, 2.0 * y, top], ""),
            levels.clone(),
            tool(
                "cube",
                [0.2, y, top + 0.042],
                &half([0.04; 3]),
                FRICTION,
                "{ free = { mass = 0.6, linear = [0.8, 0.0, -0.3], angular = [0.0, 0.0, 2.0] } }",
            ),
            ball,
        ]);
        let (mut g, mut single, mut c) = (gpu(&toml), gpu(&toml), cpu(&toml));
        let steps = (0.03 / step) as usize;
        take_at_once(&mut g, steps);
        (0..steps).for_each(|_| drop(single.step().unwrap()));
        (0..steps).for_each(|_| drop(c.step().unwrap()));
        println!("{levels}{:?}\n{:?}", g.bodies()[0], c.bodies()[0]);
        let [on_device, on_host] = steps_on_device_and_host(&g);
        assert!(on_device >= steps as u64 && on_host == 0, "{on_device} {on_host}");
        let of_levels = if is_coarse { 3 * passes_of(&g, "solve") / 2 } else { passes_of(&g, "grid") };
        assert_eq!(on_device, of_levels, "{levels}");
        // Where levels follow all bodies, nodes at rims are moved in their pass.
        let is_together = levels.contains("cube");
        assert_eq!(passes_of(&g, "answering bodies, rims"), if is_together { on_device } else { 0 }, "{levels}");
        assert!(super::left(&g) == super::left(&single), "many steps at once are something else");
        // Where a pass may bind eight buffers, bodies and rims of levels with steps of their own do not fit into one.
        if is_together {
            let (registry, options) = super::adapters::held(Wgpu { offer: Offer::Least, device: None });
            let mut poor = Simulation::new(&registry, &scene(&toml), &options).unwrap();
            take_at_once(&mut poor, steps);
            assert_eq!(passes_of(&poor, "solve") > 0, levels.contains("subcycle"));
            assert!(super::left(&g) == super::left(&poor), "the poorest adapter makes something else of it");
        }
        within("place of the cube, in cells", off(g.bodies()[0].position, c.bodies()[0].position) / h, 1e-4);
        within("velocity of the cube [m/s]", off(g.bodies()[0].velocity, c.bodies()[0].velocity), 1e-4);
        within("distance of particles, in cells", apart(&rows(&g), &rows(&c)) / h, 1e-3);
    }
}

/// In free flight a tumbling body keeps its angular momentum to the last bit, and turns as on the CPU.
#[test]
fn a_tumbling_body_keeps_its_angular_momentum() {
    let free = "{ free = { mass = 3.0, linear = [0.3, -0.2, 0.1], angular = [9.0, 0.5, -2.0] } }";
    let toml = Head::space(0.05).time("step = 5e-4").with(&[
        material("hencky", 1000.0, "young_modulus = 1e5, poisson_ratio = 0.3"),
        block("hencky", [1.0; 3], [1.2, 1.2, 1.2], ""),
        tool("brick", [0.0; 3], &half([0.1, 0.2, 0.05]), FRICTION, free),
    ]);
    let (mut g, mut c) = (gpu(&toml), cpu(&toml));
    take_at_once(&mut g, 1);
    let about_centre = |s: &Simulation| {
        let b = &s.bodies()[0];
        let orbital = [1, 2, 0].map(|i| {
            let j = (i + 1) % 3;
            b.position[i] * b.momentum[j] - b.position[j] * b.momentum[i]
        });
        let orbital: Vec3 = [orbital[0], orbital[1], orbital[2]];
        [0, 1, 2].map(|d| b.angular_momentum[d] - orbital[d])
    };
    let (start, energy) = (about_centre(&g), g.bodies()[0].kinetic_energy);
    take_at_once(&mut g, 399);
    (0..400).for_each(|_| drop(c.step().unwrap()));
    assert_eq!(steps_on_device_and_host(&g), [400, 0]);
    within("angular momentum, relative", off(about_centre(&g), start) / norm(start), 1e-12);
    within("energy, relative", (g.bodies()[0].kinetic_energy / energy - 1.0).abs(), 1e-5);
    let [a, b] = [&g, &c].map(|s| s.bodies()[0].rotation);
    within("rotation beside the CPU's", (0..4).map(|i| (a[i] - b[i]).abs()).fold(0.0, f64::max), 1e-4);
    within("place beside the CPU's, in cells", off(g.bodies()[0].position, c.bodies()[0].position) / 0.05, 1e-5);
}

/// A body that flies against a wall, and one against another, meet them as they do on the CPU, and fly on: the ground's part is the device's all the way, and its steps are not
/// written in vain but for a few.
#[test]
fn bodies_meet_walls_and_one_another_beside_the_device() {
    let bounce = |linear: Vec3| format!("{{ free = {{ mass = 1.0, linear = {linear:?}, restitution = 0.5 }} }}");
    let walls = "z_min = \"slip\"";
    let toml = Head { gravity: [0.0; 3], ..Head::cells(0.05, [40, 16, 24], walls) }.time("step = 2e-3").with(&[
        material("hencky", 1000.0, "young_modulus = 1e5, poisson_ratio = 0.3"),
        block("hencky", [1.6, 0.4, 0.2], [1.8, 0.6, 0.4], ""),
        // They do not meet at the end of a step, where rounding would say in which one.
        tool("ball", [0.4, 0.4, 0.3513], "sphere = { radius = 0.1 }", FRICTION, &bounce([0.0, 0.0, -2.0])),
        tool("left", [0.7, 0.4, 0.9], &half([0.05; 3]), FRICTION, &bounce([1.0, 0.0, 0.0])),
        tool("right", [1.2013, 0.4, 0.9], &half([0.05; 3]), FRICTION, &bounce([-1.0, 0.0, 0.0])),
    ]);
    let (mut g, mut c) = (gpu(&toml), cpu(&toml));
    take_at_once(&mut g, 250);
    (0..250).for_each(|_| drop(c.step().unwrap()));
    let [on_device, on_host] = steps_on_device_and_host(&g);
    println!("{on_device} steps on the device, {on_host} on the host; {:?}", g.bodies());
    assert!((250..275).contains(&on_device) && on_host == 0);
    assert!(g.bodies()[0].velocity[2] > 0.5 && g.bodies()[1].velocity[0] < -0.1, "nothing has bounced");
    for (a, b) in g.bodies().iter().zip(c.bodies()) {
        within(&format!("place of {}, in cells", a.name), off(a.position, b.position) / 0.05, 1e-3);
        within(&format!("velocity of {} [m/s]", a.name), off(a.velocity, b.velocity), 1e-3);
    }
}

/// A shovel goes through sand with a box in it that lies on its floor, touches its back, and is half buried; a heavy one stands in the corner of two walls. Nodes that several
/// reach are that one's in which they are deepest, whether it is driven or answers, and everything goes where it goes on the CPU.
#[test]
fn a_node_is_the_bodys_in_which_it_is_deepest() {
    let h = 0.025;
    let walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"";
    let part = |half: Vec3, at: Vec3| format!("{{ shape = {{ box = {{ half = {half:?} }} }}, position = {at:?} }}");
    let parts = [part([0.1, 0.1, 0.02], [0.0; 3]), part([0.02, 0.1, 0.08], [-0.12, 0.0, 0.06])];
    let shovel = format!("union = [{}]", parts.join(", "));
    let free = |mass: f64| format!("{{ free = {{ mass = {mass} }} }}");
    let toml = Head::cells(h, [24, 16, 16], walls).time("step = 5e-4").with(&[
        material("sand", 1500.0, "young_modulus = 2e5, poisson_ratio = 0.2, friction_angle_deg = 35"),
        block("sand", [0.0; 3], [0.6, 0.4, 0.15], ""),
        tool("shovel", [0.22, 0.2, 0.1], &shovel, FRICTION, "{ velocity = { linear = [0.4, 0.0, 0.1] } }"),
        tool("box", [0.18, 0.2, 0.161], &half([0.06, 0.05, 0.04]), FRICTION, &free(0.4)),
        tool("corner", [0.541, 0.341, 0.18], &half([0.05, 0.05, 0.04]), FRICTION, &free(3.0)),
    ]);
    let (mut g, mut single, mut c) = (gpu(&toml), gpu(&toml), cpu(&toml));
    let steps = 120;
    take_at_once(&mut g, steps);
    (0..steps).for_each(|_| drop(single.step().unwrap()));
    (0..steps).for_each(|_| drop(c.step().unwrap()));
    let [on_device, _] = steps_on_device_and_host(&g);
    assert!(on_device >= steps as u64 && passes_of(&g, "gather") == 0, "the host has gathered nodes");
    assert!(super::left(&g) == super::left(&single), "many steps at once are something else");
    println!("{:?}\n{:?}", g.bodies(), c.bodies());
    // The shovel has taken the box along, and the sand has borne the other.
    assert!(g.bodies()[1].velocity[0] > 0.3 && g.bodies()[2].position[2] > 0.15, "{:?}", g.bodies());
    for (a, b) in g.bodies().iter().zip(c.bodies()) {
        within(&format!("place of {}, in cells", a.name), off(a.position, b.position) / h, 1e-5);
        within(&format!("velocity of {} [m/s]", a.name), off(a.velocity, b.velocity), 1e-5);
    }
    for (a, b) in g.wrenches().iter().zip(c.wrenches()) {
        within("force of the ground, relative to 100 N", off(a.force, b.force) / 100.0, 1e-4);
    }
    within("distance of particles, in cells", apart(&rows(&g), &rows(&c)) / h, 1e-4);
}

/// A plate that a force pushes into sand, from wall to wall and around a post that stays, moves on the device as on the CPU.
#[test]
fn a_plate_in_a_guide_fills_its_box_on_the_device() {
    let h = 0.025;
    let walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"";
    let part =
        |at: f64| format!("{{ shape = {{ box = {{ half = [0.09, 0.15, 0.03] }} }}, position = [{at}, 0.0, 0.0] }}");
    let plate = format!("union = [{}, {}]", part(-0.11), part(0.11));
    let servo = "{ servo = { axis = [0, 0, -1], force = 150, mass = 4, damping = 20 } }";
    let toml = Head::cells(h, [16, 12, 16], walls).time("step = 5e-4").with(&[
        material("sand", 1500.0, "young_modulus = 2e5, poisson_ratio = 0.2, friction_angle_deg = 35"),
        block("sand", [0.0; 3], [0.4, 0.3, 0.125], ""),
        tool("post", [0.2, 0.15, 0.1], &half([0.02, 0.15, 0.1]), FRICTION, "\"fixed\""),
        tool("plate", [0.2, 0.15, 0.16], &plate, FRICTION, servo),
    ]);
    let (mut g, mut c) = (gpu(&toml), cpu(&toml));
    let steps = 120;
    take_at_once(&mut g, steps);
    (0..steps).for_each(|_| drop(c.step().unwrap()));
    let [on_device, _] = steps_on_device_and_host(&g);
    assert!(on_device >= steps as u64 && passes_of(&g, "gather") == 0, "the host has gathered nodes");
    println!("{:?}\n{:?}", g.bodies(), c.bodies());
    assert!(g.wrenches()[1].force[2] > 25.0, "the plate does not press: {:?}", g.wrenches());
    within("place of the plate, in cells", off(g.bodies()[1].position, c.bodies()[1].position) / h, 1e-5);
    within("velocity of the plate [m/s]", off(g.bodies()[1].velocity, c.bodies()[1].velocity), 1e-5);
    for (a, b) in g.wrenches().iter().zip(c.wrenches()) {
        within("force of the ground, relative to 150 N", off(a.force, b.force) / 150.0, 1e-3);
    }
    within("distance of particles, in cells", apart(&rows(&g), &rows(&c)) / h, 1e-4);
}

/// A body whose box holds more blocks than the device looks into has its law on the host, and a snapshot between submissions goes on as if it
/// had not been written.
#[test]
fn large_bodies_stay_on_the_host_and_snapshots_go_on() {
    let scene = |side: f64| {
        Head { gravity: [0.0, 0.0, -1.0], ..Head::space(0.02) }.time("step = 5e-4").with(&[
            material("hencky", 1000.0, "young_modulus = 1e4, poisson_ratio = 0.3"),
            block("hencky", [-0.1, -0.1, side], [0.1, 0.1, side + 0.1], "velocity = [0.0, 0.0, -1.0]"),
            tool("box", [0.0; 3], &half([side; 3]), FRICTION, "{ free = { mass = 5.0 } }"),
        ])
    };
    let mut large = gpu(&scene(0.6));
    take_at_once(&mut large, 3);
    assert_eq!(steps_on_device_and_host(&large), [0, 3]);
    let mut small = gpu(&scene(0.1));
    take_at_once(&mut small, 20);
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("run.barchan");
    small.save(&file).unwrap();
    let mut again = Simulation::resume(&barchan::registry(), &file, &super::on_gpu()).unwrap();
    take_at_once(&mut small, 30);
    take_at_once(&mut again, 30);
    assert_eq!(steps_on_device_and_host(&again), [30, 0]);
    within("place of the box, in cells", off(small.bodies()[0].position, again.bodies()[0].position) / 0.02, 1e-5);
    within("distance of particles, in cells", apart(&rows(&small), &rows(&again)) / 0.02, 1e-4);
}
