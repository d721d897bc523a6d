// Nodes at rims of levels, those that two levels share, and where these are found early those behind mirrors, some blocks a workgroup.

const TAKES: u32 = 1u;
const MOVES: u32 = 2u;
const REFLECTS: u32 = 4u;

var<workgroup> tasks: array<u32, ABREAST>;

fn rims_of(list: u32, first: u32, thread: u32) {
    let n = thread & 63u;
    abreast = thread >> 6u;
    let listed_one = listed_block(list, first + abreast);
    if n == 0u {
        tasks[abreast] = tasks_of(listed_one, list);
    }
    let all = workgroupUniformLoad(&tasks);
    var any_task = 0u;
    for (var k = 0u; k < ABREAST; k++) {
        any_task |= all[k];
    }
    let g = min(listed_one, extent.node_room - 1u);
    @if(subcycled)
    if (any_task & TAKES) != 0u {
        solve_block(g, n, (all[abreast] & TAKES) != 0u);
    }
    if (any_task & MOVES) != 0u {
        move_rim(g, n, (all[abreast] & MOVES) != 0u);
    }
    @if(subcycled)
    if (any_task & REFLECTS) != 0u {
        reflect(g, n, (all[abreast] & REFLECTS) != 0u);
    }
}

// Workgroups for blocks at rims come first; then, subcycled, those for blocks that share nodes with a finer level, the next one after those whose step it is
// among them; then those for walls, if mirrors are found here.
fn rims_and_walls(w: u32, thread: u32) {
    var list = AT_RIM;
    var number = w;
    if SUBCYCLED {
        let end = min(step.end_level, LEVELS);
        let at_rims = (listed[until_level(AT_RIM, end)] + ABREAST - 1u) / ABREAST;
        let taking = (listed[until_level(TAKING, min(end + 1u, LEVELS))] + ABREAST - 1u) / ABREAST;
        list = select(select(AT_RIM, TAKING, w >= at_rims), WALLED, MIRRORED && w >= at_rims + taking);
        number -= select(select(0u, at_rims, list == TAKING), at_rims + taking, list == WALLED);
    }
    rims_of(list, ABREAST * number, thread);
}
