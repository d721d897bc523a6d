//! Every law in WGSL against its twin on the CPU: 10⁴ states each, on whatever adapter there is.
//!
//! Reference is the law's f64 update at the very strain that the GPU is given, so that only arithmetic differs; the law's own
//! f32 update is measured beside it. Near-singular strains magnify what f32 cannot hold: there, the GPU's answer must be the f64
//! answer for a strain within a few roundings of the one given. Where those roundings are all there is, it must be finite.
#![expect(unsafe_code, reason = "the registry's tables are trusted to obey the ABI")]

#[path = "suite/libraries.rs"]
mod libraries;

use barchan::{Material, Options, Registry, Simulation};
use barchan_material_kit::random::Random;
use barchan_material_kit::{
    Answer, BARCHAN_CAP_FLUID, BARCHAN_CAP_HARDENS, Mat3, Particle, Precision, Subject, SymMat3,
};
use barchan_tests::scenes::{options, scene};
use barchan_tests::sketch::{self, Head, block};
use barchan_wgpu::{device, material};
use libraries::{build_c, c_template, root, rust_library};

/// States of each kind, for each law.
const COUNT: usize = 2000;
const DT: f64 = 1e-4;
/// Error in stress allowed, over the present λ + 2μ; or over the stress where that is greater.
const STRESS: f64 = 2e-6;
/// Error in moduli and viscosity allowed, relative to their own size.
const STIFFNESS: f64 = 1e-4;
/// Error in strain and state allowed, relative to their own size or 1.
const STATE: f64 = 1e-5;
/// Roundings of the strain given, of 2⁻²⁴ of its greatest component or 1, that the answer may be off by: those of the eigenvalues in
/// closed form, 10⁻⁶.
const ROUNDINGS: f64 = 16.0;

/// Kinds of deformation.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Kind {
    Rest,
    Small,
    Yielding,
    Large,
    /// Least stretch from 3·10⁻³.
    NearSingular,
    /// Least stretch from 10⁻⁸: its square is below the rounding of the others'.
    Degenerate,
}
use Kind::{Degenerate, Large, NearSingular, Rest, Small, Yielding};

/// H = F − I.
fn deformation(kind: Kind, inverted: bool, random: &mut Random) -> Mat3<f64> {
    let around =
        |scale: f64, random: &mut Random| Mat3::from_components(random.matrix().components().map(|x| x * scale));
    let stretched = |stretches: [f64; 3], random: &mut Random| {
        let mut diagonal = Mat3::from_components([0.0; 9]);
        (0..3).for_each(|d| diagonal.rows[d][d] = stretches[d]);
        let mut h = random.rotation() * diagonal * random.rotation();
        (0..3).for_each(|d| h.rows[d][d] -= 1.0);
        h
    };
    match kind {
        Rest => around(0.0, random),
        Small => around(1e-6, random),
        Yielding => around(0.04, random),
        Large => stretched([0; 3].map(|_| random.signed().exp2()), random),
        NearSingular | Degenerate => {
            let exponent = if kind == NearSingular { -2.5 * random.unit() } else { -3.0 - 5.0 * random.unit() };
            let least = 10f64.powf(exponent);
            let sign = if inverted && random.unit() < 0.5 { -1.0 } else { 1.0 };
            stretched([sign * least, random.signed().exp2(), random.signed().exp2()], random)
        }
    }
}

/// A state as the GPU is given it: strain minus I in f32, as nine components row by row.
struct State {
    kind: Kind,
    strain: [f32; 9],
    vel_grad: [f32; 9],
    history: Vec<f32>,
}

/// Components of the strain's planes among the nine of a matrix.
fn planes(subject: &Subject<'_>) -> &'static [usize] {
    if subject.is_left_cauchy_green() { &[0, 4, 8, 1, 2, 5] } else { &[0, 1, 2, 3, 4, 5, 6, 7, 8] }
}

fn states(law: &Material, subject: &Subject<'_>, seed: u64) -> Vec<State> {
    let mut random = Random::new(seed);
    let mut all = Vec::new();
    for kind in [Rest, Small, Yielding, Large, NearSingular, Degenerate] {
        for _ in 0..COUNT {
            let h = deformation(kind, !subject.is_left_cauchy_green(), &mut random);
            let strain = if subject.is_left_cauchy_green() {
                let own = h.times_transpose().components();
                let sum = |i: usize, j: usize, square: f64| square + h.rows[i][j] + h.rows[j][i];
                let [xx, yy, zz, xy, xz, yz] = own;
                let (xy, xz, yz) = (sum(0, 1, xy), sum(0, 2, xz), sum(1, 2, yz));
                [sum(0, 0, xx), xy, xz, xy, sum(1, 1, yy), yz, xz, yz, sum(2, 2, zz)]
            } else {
                h.components()
            };
            let history = law.states.iter().map(|variable| {
                // What has flowed before: a gap, hardening, packed snow.
                let past = if random.unit() < 0.5 { 0.0 } else { 0.2 * random.unit() };
                (variable.initial + if variable.initial > 0.5 { -past } else { past }) as f32
            });
            let history = history.collect();
            let vel_grad = random.matrix().components().map(|x| (10.0 * x) as f32);
            all.push(State { kind, strain: strain.map(|x| x as f32), vel_grad, history });
        }
    }
    all
}

impl State {
    /// The same for the CPU; `nudge` is added to the strain, in units of its rounding.
    fn particle(&self, subject: &Subject<'_>, nudge: Option<Mat3<f64>>) -> Particle {
        let mut particle = subject.particle_at_rest();
        let size = self.strain.iter().fold(1f64, |m, x| m.max(f64::from(x.abs())));
        for (plane, &c) in planes(subject).iter().enumerate() {
            particle.strain[plane] += f64::from(self.strain[c]);
            if let Some(nudge) = nudge {
                particle.strain[plane] += ROUNDINGS * 6e-8 * size * nudge.components()[c];
            }
        }
        particle.vel_grad = self.vel_grad.map(f64::from);
        for (to, from) in particle.state.iter_mut().zip(&self.history) {
            *to = f64::from(*from);
        }
        particle
    }
}

/// Tangent moduli [Pa] and viscosity [Pa s].
type Stiffness = [f64; 3];

/// One dispatch over all laws and states, through the dispatchers that the engine uses.
fn on_gpu(laws: &[(&Material, Vec<f64>, Vec<State>)]) -> Vec<Vec<(Answer, Stiffness)>> {
    const KERNEL: &str = "
        @group(0) @binding(0) var<storage, read> parameters: array<f32>;
        @group(0) @binding(1) var<storage, read> input: array<f32>;
        @group(0) @binding(2) var<storage, read_write> output: array<f32>;
        fn barchan_param(base: u32, i: u32) -> f32 { return parameters[base + i]; }
        const STRIDE: u32 = 23u + BARCHAN_MAX_STATE;
        fn matrix(at: u32) -> mat3x3<f32> {
            return transpose(mat3x3<f32>(input[at], input[at + 1u], input[at + 2u], input[at + 3u], input[at + 4u],
                input[at + 5u], input[at + 6u], input[at + 7u], input[at + 8u]));
        }
        fn put(at: u32, m: mat3x3<f32>) {
            for (var i = 0u; i < 3u; i++) {
                for (var j = 0u; j < 3u; j++) { output[at + 3u * i + j] = m[j][i]; }
            }
        }
        @compute @workgroup_size(64)
        fn main(@builtin(global_invocation_id) id: vec3<u32>) {
            let at = id.x * STRIDE;
            if at >= arrayLength(&input) { return; }
            var q: array<f32, BARCHAN_MAX_STATE>;
            for (var i = 0u; i < BARCHAN_MAX_STATE; i++) { q[i] = input[at + 23u + i]; }
            let x = MatIn(matrix(at + 2u), matrix(at + 11u), 1e-4);
            let out = update_material(bitcast<u32>(input[at]), x, bitcast<u32>(input[at + 1u]), &q);
            put(at + 2u, out.strain);
            put(at + 11u, out.kirchhoff);
            for (var i = 0u; i < BARCHAN_MAX_STATE; i++) { output[at + 23u + i] = q[i]; }
            let stiffness = stiffness_of_material(bitcast<u32>(input[at]), out.strain, bitcast<u32>(input[at + 1u]), &q);
            output[at + 20u] = stiffness.p_wave;
            output[at + 21u] = stiffness.triple_bulk;
            output[at + 22u] = stiffness.viscosity;
        }";
    let most = laws.iter().map(|(law, ..)| law.states.len()).max().unwrap_or(0).max(1);
    let stride = 23 + most;
    let (mut parameters, mut input) = (Vec::<f32>::new(), Vec::<f32>::new());
    for (i, (_, values, states)) in laws.iter().enumerate() {
        for state in states {
            input.extend([f32::from_bits(i as u32), f32::from_bits(parameters.len() as u32)]);
            input.extend(state.strain.iter().chain(&state.vel_grad).chain(&[0.0; 3]).chain(&state.history));
            input.resize(input.len().next_multiple_of(stride), 0.0);
        }
        parameters.extend(values.iter().map(|p| *p as f32));
    }
    let modules: Vec<&Material> = laws.iter().map(|(law, ..)| *law).collect();
    let text = material::module(&modules).unwrap() + KERNEL;
    // The poorest adapter must do.
    let output = dispatch(&text, &parameters, &input, (input.len() / stride).div_ceil(64) as u32);
    let mut records = output.chunks_exact(stride);
    laws.iter()
        .map(|(law, _, states)| {
            // SAFETY: the table was read from a static one, whose pointers it keeps.
            let subject = unsafe { Subject::new(&law.table) }.unwrap();
            let answer = |record: &[f32]| {
                let mut answer = Answer { strain: [0.0; 9], kirchhoff: [0.0; 6], state: [0.0; 8] };
                for (plane, &c) in planes(&subject).iter().enumerate() {
                    answer.strain[plane] = f64::from(record[2 + c]) + subject.particle_at_rest().strain[plane];
                }
                for (plane, c) in [0, 4, 8, 1, 2, 5].into_iter().enumerate() {
                    answer.kirchhoff[plane] = f64::from(record[11 + c]);
                }
                for (to, from) in answer.state.iter_mut().zip(&record[23..23 + law.states.len()]) {
                    *to = f64::from(*from);
                }
                (answer, [20, 21, 22].map(|k| f64::from(record[k])))
            };
            records.by_ref().take(states.len()).map(answer).collect()
        })
        .collect()
}

fn dispatch(text: &str, parameters: &[f32], input: &[f32], groups: u32) -> Vec<f32> {
    use wgpu::util::DeviceExt;
    let gpu = device::open_with(None, device::Offer::Least).unwrap();
    println!("{}: {} bytes of WGSL", gpu.adapter_info.name, text.len());
    let module = gpu.device.create_shader_module(wgpu::ShaderModuleDescriptor {
        label: Some("laws"),
        source: wgpu::ShaderSource::Wgsl(text.into()),
    });
    let pipeline = gpu.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
        label: Some("laws"),
        layout: None,
        module: &module,
        entry_point: Some("main"),
        compilation_options: wgpu::PipelineCompilationOptions::default(),
        cache: None,
    });
    gpu.check().unwrap();
    let filled = |values: &[f32]| {
        gpu.device.create_buffer_init(&wgpu::util::BufferInitDescriptor {
            label: None,
            contents: bytemuck::cast_slice(values),
            usage: wgpu::BufferUsages::STORAGE,
        })
    };
    let size = size_of_val(input) as u64;
    let buffer = |usage| {
        gpu.device.create_buffer(&wgpu::BufferDescriptor { label: None, size, usage, mapped_at_creation: false })
    };
    let output = buffer(wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC);
    let back = buffer(wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST);
    let (parameters, input) = (filled(parameters), filled(input));
    let entries: Vec<_> = [&parameters, &input, &output]
        .iter()
        .zip(0..)
        .map(|(buffer, binding)| wgpu::BindGroupEntry { binding, resource: buffer.as_entire_binding() })
        .collect();
    let group = gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
        label: None,
        layout: &pipeline.get_bind_group_layout(0),
        entries: &entries,
    });
    let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
    {
        let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
        pass.set_pipeline(&pipeline);
        pass.set_bind_group(0, &group, &[]);
        pass.dispatch_workgroups(groups, 1, 1);
    }
    encoder.copy_buffer_to_buffer(&output, 0, &back, 0, size);
    gpu.queue.submit([encoder.finish()]);
    back.map_async(wgpu::MapMode::Read, .., |mapped| mapped.unwrap());
    gpu.device.poll(wgpu::PollType::wait_indefinitely()).unwrap();
    gpu.check().unwrap();
    bytemuck::pod_collect_to_vec(&back.get_mapped_range(..).unwrap())
}

/// Errors of an answer in stress and in strain and state, in units of what they are measured against.
fn errors(answer: &Answer, exact: &Answer, modulus: f64) -> [f64; 2] {
    let worst = |a: &[f64], b: &[f64], least: f64| {
        let scale = b.iter().fold(least, |m, x| m.max(x.abs()));
        // NaN must not hide.
        a.iter().zip(b).map(|(a, b)| (a - b).abs() / scale).fold(0.0, |m, e| if e > m || e.is_nan() { e } else { m })
    };
    let stress = worst(&answer.kirchhoff, &exact.kirchhoff, modulus);
    let own = worst(&answer.strain, &exact.strain, 1.0).max(worst(&answer.state, &exact.state, 1.0));
    [stress, own]
}

/// Moduli and viscosity in WGSL are those that the CPU gives for the same strain and history, in laws whose bound follows the state.
fn check_stiffness(
    law: &Material,
    subject: &Subject<'_>,
    parameters: &[f64],
    answers: &[Answer],
    found: &[Stiffness],
) -> Vec<String> {
    let asked = subject.has(BARCHAN_CAP_HARDENS);
    if law.wgsl_stiffness.is_empty() {
        assert!(!asked, "{}: the bound follows the state, so there must be WGSL for it", law.name);
        return Vec::new();
    }
    let particle = |a: &Answer| Particle { strain: a.strain, state: a.state, ..subject.particle_at_rest() };
    let particles: Vec<_> = answers.iter().map(particle).collect();
    let moduli = subject.tangent_moduli(parameters, &particles).unwrap().unwrap();
    let viscosity = subject.viscosity(parameters, &particles).unwrap();
    let mut worst = 0f64;
    let mut failures = Vec::new();
    for (i, found) in found[..answers.len()].iter().enumerate() {
        let [p_wave, triple_bulk] = moduli[i];
        let own = [p_wave, triple_bulk, viscosity.as_ref().map_or(0.0, |v| v[i])];
        for (found, own) in found.iter().zip(own) {
            let error = (found - own).abs() / own.abs().max(f64::MIN_POSITIVE);
            worst = worst.max(if own == 0.0 && *found == 0.0 { 0.0 } else { error });
            let close = error <= STIFFNESS || own == *found;
            if !close {
                failures.push(format!("{} stiffness: {found} is not {own} for {:?}", law.name, answers[i]));
            }
        }
    }
    println!("{:<22}{:<14}{worst:>10.1e}", law.name, "stiffness");
    failures
}

#[test]
fn every_law_gives_the_same_answer_on_a_gpu_as_on_the_cpu() {
    let mut registry: Registry = barchan::registry();
    registry.load(&c_template(false)).unwrap();
    registry.load(&rust_library("barchan-material-template")).unwrap();
    let mut laws = Vec::new();
    for (seed, law) in registry.materials().enumerate() {
        // SAFETY: the table was read from a static one, whose pointers it keeps.
        let subject = unsafe { Subject::new(&law.table) }.unwrap();
        laws.push((law, subject.default_params(), states(law, &subject, seed as u64)));
        // Where defaults leave a branch out, once more with it.
        let varied: &[(&str, f64)] = match law.name.as_str() {
            "sand" => &[("cohesion", 2e4), ("cone", 1.0), ("friction_angle", 0.5)],
            "von_mises" => &[("hardening_modulus", 1e5)],
            "liquid" => &[("viscosity", 10.0), ("tait_exponent", 1.0)],
            _ => continue,
        };
        laws.push((law, subject.params_with(varied), states(law, &subject, 100 + seed as u64)));
    }
    let answers = on_gpu(&laws);
    let mut failures = Vec::new();
    println!("{:<22}{:<14}{:>10}{:>10}{:>12}{:>12}", "law", "kind", "stress", "own", "f32 stress", "f32 own");
    for ((law, parameters, states), answers) in laws.iter().zip(answers) {
        // SAFETY: as above.
        let subject = unsafe { Subject::new(&law.table) }.unwrap();
        let determined = states.iter().filter(|s| s.kind != Degenerate).count();
        let (states, degenerate) = states.split_at(determined);
        let (answers, stiffness): (Vec<_>, Vec<_>) = answers.into_iter().unzip();
        failures.extend(check_stiffness(law, &subject, parameters, &answers[..determined], &stiffness));
        let (answers, beyond_f32) = answers.split_at(determined);
        // A liquid resists being squashed to nothing with more than f32 can say, on the CPU as well.
        let finite = |a: &Answer| a.strain.iter().chain(&a.kirchhoff).chain(&a.state).all(|x| x.is_finite());
        if let Some(i) = beyond_f32.iter().position(|a| !finite(a)).filter(|_| !subject.has(BARCHAN_CAP_FLUID)) {
            failures.push(format!("{}: strain - I {:?} gives {:?}", law.name, degenerate[i].strain, beyond_f32[i]));
        }
        let update = |precision, nudge: Option<u64>| {
            let mut random = Random::new(nudge.unwrap_or(0));
            // Both ways along the identity, which moves the least eigenvalue most, and at random.
            let mut nudged = || match nudge {
                Some(1) => Some(Mat3::identity()),
                Some(2) => Some(Mat3::from(SymMat3::scalar(-1.0))),
                other => other.map(|_| Mat3::from(random.symmetric())),
            };
            let particles: Vec<_> = states.iter().map(|s| s.particle(&subject, nudged())).collect();
            subject.update(precision, parameters, DT, &particles).unwrap()
        };
        let exact = update(Precision::F64, None);
        let single = update(Precision::F32, None);
        let nudged = [1, 2, 3, 4].map(|seed| update(Precision::F64, Some(seed)));
        let after: Vec<_> = exact
            .iter()
            .zip(states)
            .map(|(a, s)| Particle { strain: a.strain, state: a.state, ..s.particle(&subject, None) })
            .collect();
        let moduli = subject.tangent_moduli(parameters, &after).unwrap().unwrap();
        for kind in [Rest, Small, Yielding, Large, NearSingular] {
            let (mut gpu, mut cpu) = ([0f64; 2], [0f64; 2]);
            for i in (0..states.len()).filter(|i| states[*i].kind == kind) {
                let found = errors(&answers[i], &exact[i], moduli[i][0]);
                let known = errors(&single[i], &exact[i], moduli[i][0]);
                // What a few roundings of the strain do.
                let allowed = nudged.iter().map(|n| errors(&n[i], &exact[i], moduli[i][0]));
                let slack = allowed.fold([0f64; 2], |m, e| [m[0].max(e[0]), m[1].max(e[1])]);
                for (k, tolerance) in [STRESS, STATE].into_iter().enumerate() {
                    let beyond = found[k] - if kind == NearSingular { slack[k] } else { 0.0 };
                    gpu[k] = if beyond > gpu[k] || beyond.is_nan() { beyond } else { gpu[k] };
                    cpu[k] = cpu[k].max(known[k] - if kind == NearSingular { slack[k] } else { 0.0 });
                    if beyond > tolerance || beyond.is_nan() {
                        failures.push(format!(
                            "{} {kind:?} {}: {beyond:.2e} beyond {tolerance:.0e}; strain - I {:?}, history {:?}: {:?} is not {:?}",
                            law.name,
                            ["stress", "own"][k],
                            states[i].strain,
                            states[i].history,
                            answers[i],
                            exact[i]
                        ));
                    }
                }
            }
            let kind = format!("{kind:?}");
            println!("{:<22}{kind:<14}{:>10.1e}{:>10.1e}{:>12.1e}{:>12.1e}", law.name, gpu[0], gpu[1], cpu[0], cpu[1]);
        }
    }
    println!("tolerances: stress {STRESS:.0e} of the present λ + 2μ, strain and state {STATE:.0e}");
    assert!(
        failures.is_empty(),
        "{} failures, such as\n{}",
        failures.len(),
        failures[..failures.len().min(12)].join("\n")
    );
}

/// A library's author learns what is wrong, in which material of which library, and on which line of the WGSL, when a scene that uses it is
/// assembled for a GPU; on the CPU the same library runs.
#[test]
fn a_library_without_wgsl_or_with_a_mistake_in_it_is_refused_by_name_and_line() {
    let source = std::fs::read_to_string(root().join("materials/template/c/neo_hookean.c")).unwrap();
    let folder = tempfile::tempdir().unwrap();
    for (name, from, to, said) in [
        ("c_without_wgsl", "sizeof(WGSL) - 1}", "0}", "libc_without_wgsl.so) has no WGSL"),
        (
            "c_mistaken",
            "barchan_sym(x",
            "barchan_symm(x",
            "material 'c_neo_hookean': WGSL line 3: no definition in scope",
        ),
        (
            "c_misnamed",
            "fn c_neo_hookean_update",
            "fn update",
            "WGSL line 1: 'update' does not start with 'c_neo_hookean_'",
        ),
    ] {
        assert!(source.contains(from));
        let file = folder.path().join(format!("{name}.c"));
        std::fs::write(&file, source.replace(from, to)).unwrap();
        let mut registry = barchan::registry();
        registry.load(&build_c(&file, "sim-core/abi/include", name)).unwrap();
        let text = Head::space(0.1).with(&[
            sketch::material("c_neo_hookean", 1000.0, "young_modulus = 1e4"),
            block("c_neo_hookean", [-0.2; 3], [0.2; 3], ""),
        ]);
        let cpu = options(barchan::Precision::F32);
        let gpu = Options { backend: "wgpu".to_owned(), ..cpu.clone() };
        let error = Simulation::new(&registry, &scene(&text), &gpu).unwrap_err().to_string();
        println!("{error}");
        assert!(error.contains(said) && error.contains(name), "{error}");
        Simulation::new(&registry, &scene(&text), &cpu).unwrap().step().unwrap();
    }
}
