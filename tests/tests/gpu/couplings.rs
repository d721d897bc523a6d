//! Several couplings in a scene, fields and bodies, driven and free: all of them on the device.

use super::{apart, left, off, on_gpu, passes_of, take_at_once, with_currents};
use barchan::worlds::Worlds;
use barchan::{Options, Precision, Simulation, Wrench};
use barchan_tests::scenes::{norm, rows, scene, within};
use barchan_tests::sketch::{Head, block, driven, half, material, tool};

const CURRENT: &str = "[[coupling]]\nkind = \"current\"\nparameters = { rate = 3, velocity = [0.4, 0.1, 0] }\n";
const ROLLERS: &str =
    "[[coupling]]\nkind = \"rollers\"\nparameters = { radius = 0.05, gap = 0.08, x = 0.28, z = 0.07, rate = 8 }\n";

/// A bed of sand with couplings, tools and levels.
fn yard(couplings: &str, tools: &[&str], levels: &str, step: f64) -> String {
    let walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"stick\"";
    let mut parts = vec![
        material("sand", 1500.0, "young_modulus = 1e5, poisson_ratio = 0.2"),
        block("sand", [0.0; 3], [0.4, 0.24, 0.1], "velocity = [0.1, 0.0, -0.3]"),
        couplings.to_owned(),
        levels.to_owned(),
    ];
    parts.extend(tools.iter().map(ToString::to_string));
    Head::cells(0.02, [20, 12, 16], walls).time(format!("step = {step:?}")).with(&parts)
}

fn blade() -> String {
    let shape = half([0.02, 0.06, 0.06]);
    tool("blade", [0.1, 0.12, 0.12], &shape, "{ coulomb = { friction = 0.3 } }", &driven([0.4, 0.0, 0.0]))
}

fn cube() -> String {
    let motion = "{ free = { mass = 0.4, linear = [0.0, 0.0, -0.5] } }";
    tool("cube", [0.12, 0.12, 0.128], &half([0.03; 3]), "{ coulomb = { friction = 0.5 } }", motion)
}

fn start(toml: &str, backend: &str, precision: Precision) -> Simulation {
    let options = Options { backend: backend.into(), precision, threads: 1, ..Options::default() };
    Simulation::new(&with_currents(), &scene(toml), &options).unwrap_or_else(|e| panic!("{e}\n{toml}"))
}

/// Symptom guarded against: a second coupling that sends the first one to the host, acts in another order than on the CPU, or reads the first one's table.
/// What a field, driven bodies of two kinds and free ones do together is what they do on the CPU, with nothing on the host; many
/// steps at once leave the same bits as single ones.
#[test]
fn couplings_of_all_kinds_are_on_the_device_what_they_are_on_the_cpu() {
    let (blade, cube) = (blade(), cube());
    let levels = "[levels]\ncount = 2\nhalf = 8\nagents = [\"blade\"]\n";
    let subcycled = "[levels]\ncount = 2\nhalf = 8\nagents = [\"blade\"]\nsubcycle = true\n";
    let both = [CURRENT, ROLLERS].concat();
    let turned = [ROLLERS, CURRENT].concat();
    let cases: [(&str, &[&str], &str); 7] = [
        (CURRENT, &[], ""),
        (ROLLERS, &[], ""),
        (&both, &[&blade], ""),
        (&turned, &[&blade], ""),
        (&both, &[&blade], levels),
        (&both, &[&blade], subcycled),
        (CURRENT, &[&cube], ""),
    ];
    for (couplings, tools, levels) in cases {
        let (step, steps) = if levels.contains("subcycle") { (5e-4, 20) } else { (2.5e-4, 40) };
        let toml = yard(couplings, tools, levels, step);
        let (mut many, mut single) = (start(&toml, "wgpu", Precision::F32), start(&toml, "wgpu", Precision::F32));
        let mut cpu = start(&toml, "cpu", Precision::F64);
        take_at_once(&mut many, steps);
        let mut most = vec![0f64; cpu.wrenches().len()];
        let mut worst = vec![0f64; most.len()];
        for _ in 0..steps {
            single.step().unwrap();
            cpu.step().unwrap();
            for (b, (g, c)) in single.wrenches().iter().zip(cpu.wrenches()).enumerate() {
                most[b] = most[b].max(norm(c.force));
                worst[b] = worst[b].max(off(g.force, c.force));
            }
        }
        println!("{couplings} {} tools, levels {levels:?}", tools.len());
        assert_eq!(passes_of(&many, "gather") + passes_of(&single, "gather"), 0, "steps on the host\n{toml}");
        assert!(left(&many) == left(&single), "many steps at once leave other bits\n{toml}");
        within("particles beside the CPU's, in cells", apart(&rows(&single), &rows(&cpu)) / 0.02, 2e-3);
        for (b, (worst, most)) in worst.iter().zip(&most).enumerate() {
            assert!(*most > 0.0, "{} feels nothing\n{toml}", cpu.bodies()[b].name);
            within(&format!("force on {}, of the strongest", cpu.bodies()[b].name), worst / most, 2e-2);
        }
        for (g, c) in single.bodies().iter().zip(cpu.bodies()) {
            within(&format!("place of {}, in cells", c.name), off(g.position, c.position) / 0.02, 1e-3);
        }
    }
}

fn dumbbell(more: &str) -> String {
    format!(
        "[[coupling]]\nkind = \"dumbbell\"\nparameters = {{ {more}position = [0.2, 0.12, 0.145], velocity = [0.5, 0, -0.8], angular = [2, 0, 1], turn = [0, 0.1, 0.2] }}\n"
    )
}

/// Bodies of a coupling from outside that answer together do on the device what they do on the CPU in f64, with nothing on the host: two balls on a rod that are thrown
/// into sand, alone, so near to one another that nodes are in both, and beside a field, a free tool, driven ones and levels. Many steps at once leave the same bits as
/// single ones.
#[test]
fn bodies_that_answer_together_are_on_the_device_what_they_are_on_the_cpu() {
    let (blade, cube) = (
        blade(),
        cube().replace("[0.12, 0.12, 0.128]", "[0.1, 0.12, 0.118]").replace("0.03, 0.03, 0.03", "0.02, 0.02, 0.02"),
    );
    let levels = |more: &str| format!("[levels]\ncount = 2\nhalf = 8\nagents = [\"blade\"]\n{more}");
    let far = "[[coupling]]\nkind = \"dumbbell\"\nparameters = { position = [0.27, 0.12, 0.135], velocity = [0.2, 0, -0.8], rod = 0.07, radius = 0.03 }\n";
    let [alone, near] = [dumbbell(""), dumbbell("rod = 0.05, ")];
    let with_current = [CURRENT, far].concat();
    let cases: [(&str, &[&str], &str); 6] = [
        (&alone, &[], ""),
        (&near, &[], ""),
        (&with_current, &[&cube], ""),
        (far, &[&blade], ""),
        (far, &[&blade], &levels("")),
        (far, &[&blade], &levels("subcycle = true\n")),
    ];
    for (couplings, tools, levels) in cases {
        let (step, steps) = if levels.contains("subcycle") { (5e-4, 40) } else { (2.5e-4, 80) };
        let toml =
            yard(couplings, tools, levels, step).replace("blade\"\nposition = [0.1,", "blade\"\nposition = [0.06,");
        let (mut many, mut single) = (start(&toml, "wgpu", Precision::F32), start(&toml, "wgpu", Precision::F32));
        let mut cpu = start(&toml, "cpu", Precision::F64);
        take_at_once(&mut many, steps);
        let mut sums = vec![[[0f64; 3]; 2]; cpu.wrenches().len()];
        for _ in 0..steps {
            single.step().unwrap();
            cpu.step().unwrap();
            for (sums, (g, c)) in sums.iter_mut().zip(single.wrenches().iter().zip(cpu.wrenches())) {
                (0..3).for_each(|d| sums[0][d] += g.force[d] * step);
                (0..3).for_each(|d| sums[1][d] += c.force[d] * step);
            }
        }
        println!("{couplings} {} tools, levels {levels:?}", tools.len());
        assert_eq!(passes_of(&many, "gather") + passes_of(&single, "gather"), 0, "steps on the host\n{toml}");
        assert!(passes_of(&single, "answering bodies") > 0, "nobody answers on the device\n{toml}");
        assert!(left(&many) == left(&single), "many steps at once leave other bits\n{toml}");
        within("particles beside the CPU's, in cells", apart(&rows(&single), &rows(&cpu)) / 0.02, 5e-3);
        for ((g, c), [on_device, on_cpu]) in single.bodies().iter().zip(cpu.bodies()).zip(sums) {
            assert!(norm(on_cpu) > 0.0, "{} feels nothing\n{toml}", c.name);
            within(&format!("impulse on {}, relative", c.name), off(on_device, on_cpu) / norm(on_cpu), 5e-3);
            within(&format!("place of {}, in cells", c.name), off(g.position, c.position) / 0.02, 1e-3);
            within(&format!("velocity of {} [m/s]", c.name), off(g.velocity, c.velocity), 2e-3);
        }
        let counts =
            [&single, &cpu].map(|sim| sim.ledger().counts.get("contact solutions of dumbbells not converged").copied());
        assert!(counts.iter().all(|count| count.unwrap_or(0) == 0), "{counts:?}");
    }
}

/// What a current gains, the ground loses, on the device as well: a block in free space that it drags along follows (1 + k dt)^-n.
#[test]
fn a_field_on_the_device_drags_as_its_law_says() {
    let (rate, dt, steps) = (5.0, 2e-3, 100);
    let toml = Head::space(0.1).time(format!("step = {dt}")).with(&[
        material("neo_hookean", 1000.0, "young_modulus = 1e4"),
        block("neo_hookean", [-0.2; 3], [0.2; 3], ""),
        format!("[[coupling]]\nkind = \"current\"\nparameters = {{ rate = {rate}, velocity = [1, -0.5, 0] }}\n"),
    ]);
    let mut sim = start(&toml, "wgpu", Precision::F32);
    let before = sim.ledger();
    let mut booked = [0.0; 3];
    for _ in 0..steps {
        sim.step().unwrap();
        let Wrench { force, .. } = sim.wrenches()[0];
        (0..3).for_each(|d| booked[d] -= force[d] * dt);
    }
    let after = sim.ledger();
    let share = 1.0 - (1.0f64 + rate * dt).powi(-steps);
    let speed = rows(&sim).iter().map(|row| off(row.v, [share, -0.5 * share, 0.0])).fold(0.0, f64::max);
    within("speed beside the law's [m/s]", speed, 2e-5);
    let gained: [f64; 3] = std::array::from_fn(|d| after.momentum[d] - before.momentum[d]);
    within("momentum beside what is booked, relative", off(gained, booked) / norm(booked), 1e-5);
}

/// Worlds of a batch with three couplings, each in another place of the table, are the worlds alone.
#[test]
fn worlds_with_several_couplings_are_the_worlds_alone() {
    let world = |w: usize| {
        let current = CURRENT.replace("rate = 3", &format!("rate = {}", 2 + w));
        let rollers = ROLLERS.replace("rate = 8", &format!("rate = {}", 6 + 2 * w));
        scene(&yard(&[current, rollers].concat(), &[&blade()], "", 2.5e-4))
    };
    let registry = with_currents();
    let mut worlds = Worlds::new(&registry, (0..3).map(world).collect(), &on_gpu()).unwrap();
    assert!(worlds.are_together());
    for reports in worlds.steps(40) {
        reports.unwrap();
    }
    for w in 0..3 {
        let mut alone = Simulation::new(&registry, &world(w), &on_gpu()).unwrap();
        (0..40).for_each(|_| drop(alone.step().unwrap()));
        assert!(left(worlds.world(w)) == left(&alone), "world {w} is not itself alone");
    }
}
