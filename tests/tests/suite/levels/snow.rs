//! Snow across a rim.

use super::{around_marker, on_levels};
use barchan::{Precision, Simulation};
use barchan_tests::scenes::{minus, rows, run_to, simulation, within};
use barchan_tests::sketch::{Head, block, material};

/// Moduli of the snow [Pa], its critical compression and its hardening, as in Stomakhin et al. 2013.
const MODULUS: f64 = 1.4e5 * 0.8 / (1.2 * 0.6);
const CRITICAL: f64 = 2.5e-2;
const HARDENING: f64 = 10.0;

/// Kirchhoff stress of snow squeezed to `stretch` of its height between walls [Pa].
fn oedometer(stretch: f64) -> f64 {
    let elastic = stretch.max(1.0 - CRITICAL);
    (HARDENING * (1.0 - stretch / elastic)).exp() * MODULUS * (elastic - 1.0) * elastic
}

/// Stretch at which snow between walls bears the pressure [Pa].
fn stretch_under(pressure: f64) -> f64 {
    let (mut low, mut high) = (0.5, 1.0);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if -oedometer(middle) / middle > pressure {
            low = middle;
        } else {
            high = middle;
        }
    }
    0.5 * (low + high)
}

/// True stresses along z [Pa] by id, from Kirchhoff stress and the volume that snow keeps.
fn stresses(column: &Simulation) -> Vec<(u64, f64)> {
    let mut by_id = Vec::new();
    for list in &column.particles().lists {
        let all: Vec<usize> = (0..list.len()).collect();
        let tau = barchan::stress::kirchhoff(&column.plan().materials[list.material as usize], list, &all).unwrap();
        for i in all {
            let b: Vec<f64> = list.strain.iter().map(|plane| plane[i]).collect();
            let det = b[0] * (b[1] * b[2] - b[5] * b[5]) - b[3] * (b[3] * b[2] - b[5] * b[4])
                + b[4] * (b[3] * b[5] - b[1] * b[4]);
            by_id.push((list.id[i], tau[i][2] / (det.sqrt() * list.state[0][i])));
        }
    }
    by_id.sort_by_key(|(id, _)| *id);
    by_id
}

/// A3 and A5 for snow across a rim. Symptom: where packed snow meets loose snow at a rim, stress jumps, or history that changes level loses its
/// hardening and the column sinks in. Physics: sigma_zz = -rho g (H - z) on both sides, and every layer is squeezed to where the law's
/// closed form bears that; the lower part is beyond its yield.
#[test]
fn snow_packs_under_its_weight_across_a_rim() {
    let (h, height, rho, g) = (0.04, 0.96, 400.0, 20.0);
    for (precision, tolerance) in [(Precision::F64, 0.02), (Precision::F32, 0.03)] {
        let walls = "x_min = \"slip\"\nx_max = \"slip\"\ny_min = \"slip\"\ny_max = \"slip\"\nz_min = \"slip\"";
        let head = Head { gravity: [0.0, 0.0, -g], gravity_ramp: 3.0, ..Head::cells(h, [4, 4, 32], walls) };
        // Fine above the middle, where snow begins to yield.
        let rim = 0.48;
        let scene = head.time("safety = 0.5").with(&[
            material("snow", rho, ""),
            block("snow", [0.0; 3], [4.0 * h, 4.0 * h, height], ""),
            around_marker(2, 16, [2.0 * h, 2.0 * h, rim + 16.0 * h]),
        ]);
        let mut column = simulation(&scene, precision);
        let (start, levels) = (rows(&column), on_levels(&column));
        // Layers two fine cells thick: particles, height at the start, stress, and how far they have come down.
        let mut layers = vec![[0.0; 4]; 12];
        for sample in 0..20 {
            run_to(&mut column, 3.1 + 0.01 * f64::from(sample));
            for (row, (id, stress)) in rows(&column).iter().zip(stresses(&column)) {
                let Ok(at) = start.binary_search_by_key(&id, |r| r.id) else { continue };
                if start[at].volume0 == row.volume0 {
                    let z = start[at].x[2];
                    let layer = &mut layers[(z / (2.0 * h)) as usize];
                    let add = [row.m, row.m * z, row.m * stress, row.m * minus(start[at].x, row.x)[2]];
                    (0..4).for_each(|i| layer[i] += add[i]);
                }
            }
        }
        println!("A3 snow {precision}: {levels:?} -> {:?}, {:?}", on_levels(&column), column.ledger().counts);
        assert!(levels.iter().all(|&n| n > 100));
        let (mut off_stress, mut off_sunk, mut packed) = (0f64, 0f64, 0);
        let total: f64 =
            (0..960).map(|i| 1e-3 * (1.0 - stretch_under(rho * g * (height - 1e-3 * (f64::from(i) + 0.5))))).sum();
        for layer in &layers[1..10] {
            let [m, z, stress, sunk] = *layer;
            let (z, stress, sunk) = (z / m, stress / m, sunk / m);
            let pressure = rho * g * (height - z);
            packed += u32::from(stretch_under(pressure) < 1.0 - CRITICAL);
            let steps = 200;
            let expected: f64 = (0..steps)
                .map(|i| {
                    let dz = z / f64::from(steps);
                    dz * (1.0 - stretch_under(rho * g * (height - dz * (f64::from(i) + 0.5))))
                })
                .sum();
            off_stress = off_stress.max((stress + pressure).abs() / (rho * g * height));
            off_sunk = off_sunk.max((sunk - expected).abs() / total);
            println!(
                "  z {z:.3}: {stress:.0} Pa for {:.0}; sunk {:.2} mm for {:.2}",
                -pressure,
                1e3 * sunk,
                1e3 * expected
            );
        }
        assert!((3..=6).contains(&packed), "part of the column yields: {packed}");
        within(&format!("A3 snow {precision}: sigma_zz over rho g H, off by"), off_stress, tolerance);
        within(&format!("A3 snow {precision}: how far layers sink, over the top's, off by"), off_sunk, tolerance);
    }
}
