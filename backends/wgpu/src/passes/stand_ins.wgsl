// For tests alone: what Rust writes before or into the text of passes, as a scene might have it, so that each file can be read without the others.

// What a scene fixes: `scene.rs`.
const IS_PERIODIC = vec3<bool>(false, true, false);
const IS_NARROW = vec3<bool>(true, false, false);
const LOW = vec3<u32>(1u, 0u, 2u);
const HIGH = vec3<u32>(1u, 0u, 0u);
const HAS_LOW_WALL = vec3<bool>(true, false, true);
const HAS_HIGH_WALL = vec3<bool>(true, false, false);
const LOW_FRICTION = vec3<f32>(0.4, -1.0, -1.0);
const HIGH_FRICTION = vec3<f32>(-1.0, -1.0, -1.0);
const NODE_MOVE: f32 = 1.0;
const MAX_DEFORMATION: f32 = 0.1;
const MAX_PARTS: f32 = 8.0;
const REST: u32 = 2u;
const GRAVITY_GROWS: bool = true;
const SLOW: f32 = 1e-4;
const RESTED: u32 = 100u;
const FALLS: f32 = 25.0;
const LAYERS: u32 = 6u;
const LEVELS: u32 = 3u;
const SUBCYCLED: bool = true;
const MIRRORED: bool = true;
const MAX_STEPS: u32 = 512u;
const FREE_ROOM: u32 = 1u;
const RIMS_BESIDE: u32 = 8u;
const SORT_EVERY = vec3<u32>(4u, 20u, 160u);
const TOGETHER: u32 = 4u;
const ROUNDS: u32 = 8u;
const LEFT_HOME: u32 = 33554432u;
const BESIDE: u32 = 67108864u;
const BESIDE_BY: u32 = 1048576u;
const SORT_DRIFT = vec3<f32>(0.5, 0.1, 0.002);
const MAX_DRIFT: f32 = 1.0;
const PRESSING: u32 = 256u;
const BOXES: u32 = 1u;
const PER_WORLD: u32 = 8u;
const SPLIT_AHEAD: i32 = 1;

// What single passes fix.
const ABREAST: u32 = 4u;
const BY_WORKGROUP: u32 = 512u;
const MERGE_LEFT: i32 = 2;
const LESS: f32 = 0.99999;
const MORE: f32 = 1.00001;
const AXIS: u32 = 0u;
const SOFTS: u32 = 1u;
const BODIES: u32 = 1u;
const MATERIALS: u32 = 1u;
const MODULI: u32 = 1u;
const GROUPS: u32 = 1u;
const ANSWERING: u32 = 2u;
const GROUP_BODIES: u32 = 2u;
const GROUP_WORDS: u32 = 8u;
const GROUP_TOLD: u32 = 4u;
const GROUP_RATES: u32 = 3u;
const MAX_SLOTS: u32 = 256u;
const REACH: f32 = 1.5;
const NEAR_TOOL: f32 = 2.0;
const NEAR_BLOCK: u32 = 65u;
const SECTIONS: u32 = 2u;
const PARTS: u32 = 2u;
const PROBED: u32 = 4u;
const REGIONS: u32 = 16u;
var<workgroup> exchange: array<vec4<f32>, 715>;
fn finest_volume(body: u32) -> f32 { return 1e-6; }
fn number_of(body: u32) -> u32 { return 0u; }

// Buffers: `binding.rs`. Those that a pass reads only, and those of the next sort under the names of these, are written here.
@group(0) @binding(1) var<uniform> regions: array<vec4<i32>, 16>;
@group(0) @binding(2) var<storage, read_write> lists: array<vec4<i32>>;
@group(0) @binding(3) var<storage, read_write> cells: array<u32>;
@group(0) @binding(4) var<storage, read_write> grid: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> status: array<atomic<u32>>;
@group(0) @binding(6) var<storage, read_write> flags: array<u32>;
@group(0) @binding(7) var<storage, read_write> directory: array<vec2<u32>>;
@group(0) @binding(8) var<storage, read_write> sums: array<vec2<u32>>;
@group(0) @binding(9) var<storage, read_write> keys: array<vec2<u32>>;
@group(0) @binding(10) var<storage, read_write> loose: array<u32>;
@group(0) @binding(11) var<storage, read_write> order: array<u32>;
@group(0) @binding(12) var<storage, read_write> owners: array<vec2<u32>>;
@group(0) @binding(13) var<storage, read_write> ids: array<vec2<u32>>;
@group(0) @binding(14) var<storage, read_write> counts: array<u32>;
@group(0) @binding(15) var<storage, read_write> rims: array<vec4<u32>>;
@group(0) @binding(16) var<storage, read_write> handed: array<vec4<f32>>;
@group(0) @binding(17) var<storage, read_write> shared_nodes: array<vec4<f32>>;
@group(0) @binding(18) var<storage, read_write> live: array<vec2<i32>>;
@group(0) @binding(19) var<storage, read_write> listed: array<u32>;
@group(0) @binding(20) var<storage, read_write> answering: array<vec4<u32>>;
@group(0) @binding(21) var<storage, read_write> pairs: array<vec4<f32>>;
@group(0) @binding(22) var<storage, read_write> watch: array<atomic<u32>>;
@group(0) @binding(23) var<storage, read_write> old_watch: array<atomic<u32>>;
@group(0) @binding(24) var<storage, read_write> old_lists: array<vec4<i32>>;
@group(0) @binding(25) var<storage, read_write> new_ids: array<vec2<u32>>;
@group(0) @binding(26) var<storage, read_write> filled: array<vec4<u32>>;
@group(0) @binding(27) var<storage, read_write> groups: array<u32>;
@group(0) @binding(28) var<storage, read_write> softs: array<atomic<i32>>;
@group(0) @binding(29) var<storage, read_write> tools: array<vec4<i32>>;
@group(0) @binding(30) var<storage, read_write> bodies: array<vec4<f32>>;
@group(0) @binding(31) var<storage, read_write> partials: array<vec4<f32>>;
@group(0) @binding(32) var<storage, read_write> impulses: array<vec4<f32>>;
@group(0) @binding(33) var<storage, read_write> near: array<vec4<u32>>;
@group(0) @binding(34) var<storage, read_write> around: array<vec4<i32>>;
@group(0) @binding(35) var<storage, read_write> probed: array<atomic<u32>>;
@group(0) @binding(36) var<storage, read_write> looked: array<u32>;
fn record_of(q: u32, k: u32) -> vec4<u32> { return vec4<u32>(q, k, 0u, 0u); }
fn set_record(q: u32, k: u32, value: vec4<u32>) {}
fn rest_of(q: u32, k: u32) -> vec4<f32> { return vec4<f32>(0.0); }
fn set_rest(q: u32, k: u32, value: vec4<f32>) {}
fn set_new_record(q: u32, k: u32, value: vec4<u32>) {}
fn set_new_rest(q: u32, k: u32, value: vec4<f32>) {}

// Laws: `laws.rs`, and what they give themselves.
const BARCHAN_MAX_STATE: u32 = 4u;
struct Held { r0: vec4<f32> }
fn held_by(q: u32) -> Held { return Held(rest_of(q, 0u)); }
fn rest_volume(held: Held) -> f32 { return held.r0.w; }
fn barchan_param(base: u32, i: u32) -> f32 { return 1.0; }
fn param_base(law: u32) -> u32 { return 0u; }
fn has_def_grad(law: u32) -> bool { return true; }
fn wants_rate(law: u32) -> bool { return true; }
fn is_damped(law: u32) -> bool { return true; }
fn damping_at(law: u32) -> u32 { return 0u; }
fn gives_stiffness(law: u32) -> bool { return true; }
fn update_material(law: u32, x: MatIn, base: u32, state: ptr<function, array<f32, BARCHAN_MAX_STATE>>) -> MatOut { return MatOut(); }
fn stiffness_of_material(law: u32, strain: mat3x3<f32>, base: u32, state: ptr<function, array<f32, BARCHAN_MAX_STATE>>) -> Stiffness {
    return Stiffness();
}

// Couplings: `couplings.rs`.
fn is_field(body: u32) -> bool { return false; }
fn coupling_table(i: u32) -> vec4<f32> { return vec4<f32>(0.0); }
fn coupling_field(body: u32, x: vec3<f32>, u: vec3<f32>, mass: f32, dt: f32) -> vec3<f32> { return u; }
fn coupling_distance(body: u32, x: vec3<f32>, cell: f32) -> f32 { return 1.0; }
fn coupling_press(body: u32, x: vec3<f32>, half: f32, modulus: f32, cell: f32) -> vec3<f32> { return vec3<f32>(0.0); }
fn coupling_grip(body: u32, x: vec3<f32>, cell: f32, press: vec3<f32>) -> CouplingGrip {
    return CouplingGrip(GRIP_NONE, vec3<f32>(0.0), 0.0, false, 1e30);
}
fn coupling_friction(body: u32) -> f32 { return 0.0; }
fn coupling_box(body: u32, rows: array<vec3<f32>, 3>, cell: f32) -> array<vec3<f32>, 2> {
    return array<vec3<f32>, 2>(vec3<f32>(1e30), vec3<f32>(-1e30));
}

fn number_in_coupling(body: u32) -> u32 { return body; }
fn take_up_group(thread: u32) {}
fn coupling_begin(group: u32, thread: u32) {}
fn coupling_answer(group: u32, thread: u32) {}
fn coupling_balance(group: u32, along: u32, thread: u32) -> f32 { return 0.0; }
fn coupling_twice_energy(group: u32, which: u32, thread: u32) -> f32 { return 0.0; }
fn coupling_feel(group: u32, thread: u32) {}
fn coupling_advance(group: u32, thread: u32) {}

// Text that is written out: `unrolled.rs`, `laws.rs`.
fn unrolled_zero() {}
fn unrolled_clear() {}
fn unrolled_own_xy() {}
fn unrolled_own_zm() {}
fn unrolled_unit_xy() {}
fn unrolled_unit_zm() {}
fn unrolled_guests_xy() {}
fn unrolled_guests_zm() {}
fn unrolled_fold() {}
fn unrolled_flush() {}
fn unrolled_flush_in_turn() {}
fn unrolled_gather() {}
fn unrolled_load() {}
fn unrolled_store() {}
