//! Surfaces of terrains.

use barchan_core::scene::{Heights, Surface, Terrain};

fn heights(surface: Surface) -> Heights {
    Terrain { min: [-50.0; 2], max: [50.0; 2], bottom: -1.0, origin: [0.3, -0.2, 0.5], surface }.heights()
}

/// All surfaces of the tests, with their least and greatest height.
fn surfaces() -> [(Surface, [f64; 2]); 6] {
    let dunes = |wind_deg, seed| Surface::Dunes { wavelength: 2.0, height: 0.3, wind_deg, lee_deg: 30.0, seed };
    let endless = [f64::NEG_INFINITY, f64::INFINITY];
    [
        (Surface::Flat, [0.5, 0.5]),
        (Surface::Slope { slope_deg: 12.0, direction_deg: 30.0 }, endless),
        (dunes(0.0, 0), [0.5, 0.8]),
        (dunes(-70.0, 9), [0.5, 0.8]),
        (Surface::Bumps { wavelength: 0.8, height: 0.1, seed: 4 }, [0.5, 0.6]),
        (Surface::Stairs { run: 0.3, rise: -0.1, count: 6, direction_deg: 90.0 }, [-0.1, 0.5]),
    ]
}

/// Places from near the origin to 1000 km away.
fn places() -> impl Iterator<Item = [f64; 2]> {
    (0..4000_u32).map(|i| {
        let far = [1.0, 30.0, 1e3, 1e6][i as usize % 4];
        [0.618_033_988_749_895, 0.414_213_562_373_095].map(|part| far * (2.0 * (f64::from(i) * part).fract() - 1.0))
    })
}

/// What is left out because a rectangle is said to lie above or below the surface must lie there, and no slope is above that which is said.
#[test]
fn heights_stay_within_their_bounds_and_slopes() {
    for (surface, [least, greatest]) in surfaces() {
        let heights = heights(surface);
        for [x, y] in places() {
            let side = 0.01 + 0.2 * x.abs().fract();
            let [low, high] = heights.within([x, y], [x + side, y + 0.5 * side]);
            let here = heights.at(x, y);
            assert!((least - 1e-9..=greatest + 1e-9).contains(&here), "{surface:?} at {x}, {y}: {here}");
            for (a, b) in [(1.0, 0.5), (0.5, 0.25), (0.1, 0.4)] {
                let there = heights.at(x + a * side, y + b * side);
                assert!((low - 1e-9..=high + 1e-9).contains(&there), "{surface:?} at {x}, {y}: {low} {there} {high}");
                let way = side * (a * a + b * b).sqrt();
                assert!((there - here).abs() <= heights.steepest() * way + 1e-9, "{surface:?} at {x}, {y}");
            }
        }
    }
}

/// Wind climbs dunes gently and leaves a steep lee: of the slopes along the wind, more lead up than down, and the steepest lead down.
#[test]
fn dunes_are_gentle_in_the_wind_and_steep_in_the_lee() {
    let surface = Surface::Dunes { wavelength: 2.0, height: 0.3, wind_deg: 0.0, lee_deg: 30.0, seed: 5 };
    let heights = heights(surface);
    let rise = |[x, y]: [f64; 2]| (heights.at(x + 1e-3, y) - heights.at(x, y)) / 1e-3;
    let slopes: Vec<f64> = (0..20_000).map(|i| rise([0.0173 * f64::from(i), 0.31 * f64::from(i % 100)])).collect();
    let [up, down] = [1.0, -1.0].map(|sign| slopes.iter().filter(|s| sign * **s > 0.0).count());
    let steepest = |sign: f64| slopes.iter().fold(0f64, |most, s| most.max(sign * s)).atan().to_degrees();
    println!("{up} up, at most {:.1} degrees; {down} down, at most {:.1}", steepest(1.0), steepest(-1.0));
    assert!(up > 14 * down / 10, "{up} up, {down} down");
    assert!(steepest(-1.0) > 22.0 && steepest(-1.0) <= 30.01, "lee {}", steepest(-1.0));
    assert!(steepest(1.0) < 25.0, "windward {}", steepest(1.0));
}

/// Bits that a machine with another library of sines, or fused products, would miss.
#[test]
fn heights_are_the_same_bits_everywhere() {
    let sum = |surface| {
        let heights = heights(surface);
        places().fold(0u64, |sum, [x, y]| sum.rotate_left(5) ^ heights.at(x, y).to_bits())
    };
    let sums = surfaces().map(|(surface, _)| sum(surface));
    let kept = [
        0xcf83_18c6_307c_e739,
        0xda64_d762_f758_00aa,
        0x6c53_c5f9_42ad_d9d6,
        0x46ae_d8e7_7870_bc4a,
        0x4463_6802_e323_31a6,
        0x8540_1ffb_299f_d48c,
    ];
    assert!(sums == kept, "{sums:#x?}");
}
