
var<workgroup> is_frozen: u32;
// The block's count, in the invocation that asks whether the block gives to its tile.
var<private> rests: u32;

// From here on, what the watch has decided holds.
fn settle(b: u32) {
    let here = min(b, extent.block_room - 1u);
    let decided = atomicLoad(&watch[watch_word(here, DECIDED)]);
    let before = atomicLoad(&watch[watch_word(here, RESTS)]);
    rests = select(decided, before, decided == NONE);
    if decided != NONE && b < atomicLoad(&status[BLOCKS]) {
        atomicStore(&watch[watch_word(b, RESTS)], decided);
        atomicStore(&watch[watch_word(b, HAPPENED)], 0u);
        atomicStore(&watch[watch_word(b, DECIDED)], NONE);
    }
}

// Does a block give to its tile? One asleep does if the tile is not yet for a step like this one.
fn gives(b: u32, layer: u32) -> u32 {
    if rests != ASLEEP {
        return 1u;
    }
    var gravity = bitcast<u32>(1.0);
    if GRAVITY_GROWS {
        gravity = atomicLoad(&status[step_word(step.number, layer, GROWN)]);
    }
    let filled = watch_word(b, FILLED);
    let filled_gravity = watch_word(b, FILLED_GRAVITY);
    let length = bitcast<u32>(step.dt);
    if atomicLoad(&watch[filled]) == length && atomicLoad(&watch[filled_gravity]) == gravity {
        return 0u;
    }
    atomicStore(&watch[filled], length);
    atomicStore(&watch[filled_gravity], gravity);
    is_frozen = 1u;
    return 1u;
}
