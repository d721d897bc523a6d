//! Time of one step, and of its parts: `cargo bench -p barchan-tests`.
//!
//! Whole-program figures, the ones quoted in docs/performance.md, come from `barchan bench throughput`; this bench is for
//! comparing two versions of a kernel on one machine.

use barchan::{Precision, Simulation};
use barchan_tests::scenes::simulation;
use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};

/// A bed of 39 x 39 x 10 cells with eight particles each, at rest on a floor.
fn bed(law: &str, precision: Precision) -> Simulation {
    simulation(
        &format!(
            r#"
            name = "bed"
            [world]
            cell = 0.02
            min = [0.0, 0.0, 0.0]
            max = [0.78, 0.78, 0.4]
            walls = {{ x_min = "slip", x_max = "slip", y_min = "slip", y_max = "slip", z_min = "stick" }}
            [time]
            end = 1.0
            step = 1e-4
            [[material]]
            name = "m"
            law = "{law}"
            density = 1000.0
            [[body]]
            material = "m"
            shape = {{ box = {{ min = [0.0, 0.0, 0.0], max = [0.78, 0.78, 0.2] }} }}
            "#
        ),
        precision,
    )
}

fn step(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("step");
    group.sample_size(20);
    for (law, precision) in [
        ("sand", Precision::F32),
        ("neo_hookean", Precision::F32),
        ("fixed_corotated", Precision::F32),
        ("snow", Precision::F32),
        ("von_mises", Precision::F32),
        ("liquid", Precision::F32),
        ("sand", Precision::F64),
    ] {
        let mut bed = bed(law, precision);
        group.throughput(Throughput::Elements(bed.particle_count() as u64));
        group.bench_function(BenchmarkId::new(law, precision), |b| b.iter(|| bed.step().expect("a stable step")));
    }
    group.finish();
}

criterion_group!(benches, step);
criterion_main!(benches);
