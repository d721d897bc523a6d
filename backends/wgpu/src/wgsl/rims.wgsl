// Nodes at rims of levels, and those that two levels share, four blocks a workgroup.

const TAKES: u32 = 1u;
const MOVES: u32 = 2u;

var<workgroup> tasks: array<u32, ABREAST>;

fn rims_of(first: u32, thread: u32) {
    let n = thread & 63u;
    abreast = thread >> 6u;
    let listed_one = listed_block(AT_RIM, first + abreast);
    if n == 0u {
        tasks[abreast] = tasks_of(listed_one);
    }
    let all = workgroupUniformLoad(&tasks);
    var any_task = 0u;
    for (var k = 0u; k < ABREAST; k++) {
        any_task |= all[k];
    }
    let g = min(listed_one, extent.node_room - 1u);
    $TAKE
    if (any_task & MOVES) != 0u {
        move_rim(g, n, (all[abreast] & MOVES) != 0u);
    }
}
