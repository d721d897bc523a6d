
// Where there are layers, or ground sleeps, the first things that must be known of a particle wait for one another, and are asked for before it is known
// whether the step goes on: its block and mass, its place, and its layer. Where there is one layer alone, awake, that would cost an H200 4 % of the pass.
var<private> owner: vec2<u32>;
var<private> place: vec4<u32>;

fn ask(q: u32) {
    let at = min(q, extent.particles - 1u);
    owner = owners[at];
    place = record_of(at, 0u);
    if LAYERS > 1u {
        layer_now = u32(lists[owner.x * ENTRY].w);
    }
}
