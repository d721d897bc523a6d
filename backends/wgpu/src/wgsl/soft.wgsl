// Soft bodies that levels follow: the cells around their particles after a step, in cells of the finest level. For each there stand the least
// cell and one past the greatest as they are found, and as they were after the last step, and between which bounds both and their sum may lie
// before levels have to move, and how far the least may go.
const WORDS: u32 = 27u;

var<workgroup> ends: array<atomic<i32>, 6u * SOFTS>;
var<workgroup> first_world: u32;

fn layer_of(q: u32) -> u32 {
    return u32(lists[owners[min(q, extent.particles - 1u)].x * ENTRY].w);
}

@compute @workgroup_size(128)
fn measure(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let q = (group.y * extent.row + group.x) * 128u + thread;
    for (var t = thread; t < 6u * SOFTS; t += 128u) {
        atomicStore(&ends[t], select(-0x7fffffff - 1, 0x7fffffff, t % 6u < 3u));
    }
    if thread == 0u {
        first_world = layer_of(q) / LEVELS;
    }
    let world = workgroupUniformLoad(&first_world);
    if q < extent.particles && atomicLoad(&status[HALTED]) == 0u {
        let layer = layer_of(q);
        let soft = number_of(ids[q].y);
        if soft < SOFTS && is_live(layer) {
            let shift = vec3<u32>(level_of(layer));
            let cell = 4 * lists[owners[q].x * ENTRY].xyz + cell_of(record_of(q, 0u).w);
            let least = cell << shift;
            let end = (cell + vec3<i32>(1)) << shift;
            for (var d = 0u; d < 3u; d++) {
                if layer / LEVELS == world {
                    atomicMin(&ends[6u * soft + d], least[d]);
                    atomicMax(&ends[6u * soft + 3u + d], end[d]);
                } else {
                    let at = WORDS * (layer / LEVELS * SOFTS + soft) + d;
                    atomicMin(&softs[at], least[d]);
                    atomicMax(&softs[at + 3u], end[d]);
                }
            }
        }
    }
    workgroupBarrier();
    for (var t = thread; t < 6u * SOFTS; t += 128u) {
        let at = WORDS * (world * SOFTS + t / 6u) + t % 6u;
        let found = atomicLoad(&ends[t]);
        if t % 6u < 3u {
            atomicMin(&softs[at], found);
        } else {
            atomicMax(&softs[at], found);
        }
    }
}
