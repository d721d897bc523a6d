//! Laws on a device at single points, without a simulation: what holds a law's WGSL to its form on the processor.

use crate::device::{Gpu, memory};
use crate::material;
use barchan_core::{Material, Result};

/// What a law is asked at a point, as a device is given it.
#[derive(Clone, Debug, PartialEq)]
pub struct Point {
    /// Trial strain minus I, row by row: F − I, or b − I by the material's strain kind [1].
    pub strain: [f32; 9],
    /// Velocity gradient, row by row [1/s].
    pub vel_grad: [f32; 9],
    /// State variables, as many as the material has.
    pub state: Vec<f32>,
}

/// What its WGSL answers there.
#[derive(Clone, Debug, PartialEq)]
pub struct PointAnswer {
    /// Strain minus I after the return map, row by row [1].
    pub strain: [f32; 9],
    /// Kirchhoff stress, row by row [Pa].
    pub kirchhoff: [f32; 9],
    /// State variables.
    pub state: Vec<f32>,
    /// λ + 2μ and 3λ + 2μ [Pa] and viscosity [Pa s] after the update; zeros of a law without WGSL for them.
    pub stiffness: [f32; 3],
}

/// A law with parameters, and where it is asked.
#[derive(Clone, Copy, Debug)]
pub struct Asked<'a> {
    /// The law.
    pub law: &'a Material,
    /// Its parameters, in their order.
    pub parameters: &'a [f64],
    /// The points.
    pub points: &'a [Point],
}

/// Floats of a point before its state: law, first parameter, two tensors, stiffness.
const HEAD: usize = 23;
/// Threads of a workgroup.
const GROUP: usize = 64;

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
    let law = bitcast<u32>(input[at]);
    let base = bitcast<u32>(input[at + 1u]);
    let out = update_material(law, MatIn(matrix(at + 2u), matrix(at + 11u), input[at + 20u]), base, &q);
    put(at + 2u, out.strain);
    put(at + 11u, out.kirchhoff);
    for (var i = 0u; i < BARCHAN_MAX_STATE; i++) { output[at + 23u + i] = q[i]; }
    let stiffness = stiffness_of_material(law, out.strain, base, &q);
    output[at + 20u] = stiffness.p_wave;
    output[at + 21u] = stiffness.triple_bulk;
    output[at + 22u] = stiffness.viscosity;
}
";

/// Asks laws at points, over steps of `dt` [s], in one dispatch through the dispatchers that steps use. Answers stand in the order of the laws, and
/// of the points of each.
///
/// # Errors
/// [`Error::Missing`](barchan_core::Error::Missing) if a law has no WGSL, [`Error::Plugin`](barchan_core::Error::Plugin) naming its line if that is
/// wrong, and [`Error::Device`](barchan_core::Error::Device) if the device fails.
pub fn evaluate(gpu: &Gpu, dt: f32, asked: &[Asked<'_>]) -> Result<Vec<Vec<PointAnswer>>> {
    let laws: Vec<&Material> = asked.iter().map(|a| a.law).collect();
    let text = material::module(&laws)? + KERNEL;
    let most = laws.iter().map(|law| law.states.len()).max().unwrap_or(0).max(1);
    let stride = HEAD + most;
    let (mut parameters, mut input) = (Vec::<f32>::new(), Vec::<f32>::new());
    for (number, Asked { parameters: own, points, .. }) in asked.iter().enumerate() {
        for point in *points {
            input.extend([f32::from_bits(number as u32), f32::from_bits(parameters.len() as u32)]);
            input.extend(point.strain.iter().chain(&point.vel_grad).chain(&[dt, 0.0, 0.0]).chain(&point.state));
            input.resize(input.len().next_multiple_of(stride), 0.0);
        }
        parameters.extend(own.iter().map(|p| *p as f32));
    }
    if input.is_empty() {
        return Ok(vec![Vec::new(); asked.len()]);
    }
    // A binding holds at least one value.
    parameters.push(0.0);
    let output = dispatch(gpu, &text, &parameters, &input, stride)?;
    let mut records = output.chunks_exact(stride);
    let answer = |record: &[f32], states: usize| PointAnswer {
        strain: std::array::from_fn(|c| record[2 + c]),
        kirchhoff: std::array::from_fn(|c| record[11 + c]),
        state: record[HEAD..HEAD + states].to_vec(),
        stiffness: std::array::from_fn(|k| record[20 + k]),
    };
    Ok(asked
        .iter()
        .map(|a| records.by_ref().take(a.points.len()).map(|record| answer(record, a.law.states.len())).collect())
        .collect())
}

fn dispatch(gpu: &Gpu, text: &str, parameters: &[f32], input: &[f32], stride: usize) -> Result<Vec<f32>> {
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
    gpu.check()?;
    let buffer = |values: &[f32], usage| {
        let buffer = gpu.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("points"),
            size: size_of_val(values) as u64,
            usage: usage | wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        gpu.queue.write_buffer(&buffer, 0, bytemuck::cast_slice(values));
        buffer
    };
    let none = wgpu::BufferUsages::empty();
    // What nothing was written to would be read as zeros; NaN is seen.
    let unwritten = vec![f32::NAN; input.len()];
    let buffers = [buffer(parameters, none), buffer(input, none), buffer(&unwritten, wgpu::BufferUsages::COPY_SRC)];
    let entries: Vec<_> = (0..)
        .zip(&buffers)
        .map(|(binding, buffer)| wgpu::BindGroupEntry { binding, resource: buffer.as_entire_binding() })
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
        pass.dispatch_workgroups((input.len() / stride).div_ceil(GROUP) as u32, 1, 1);
    }
    gpu.queue.submit([encoder.finish()]);
    memory::read(gpu, &buffers[2], 0, input.len())
}
