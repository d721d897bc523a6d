
// What is known of the rest of a block's particles, in words.
const WATCHED: u32 = 12u;
// For how many steps they have been slow, up to RESTED; ASLEEP in its place.
const RESTS: u32 = 0u;
// What that is from the next P2G on, or NONE: while the watch goes round, neighbours see what was.
const DECIDED: u32 = 1u;
// What has happened since it was decided, as bits: a step; one in which something was fast; particles have come or gone.
const HAPPENED: u32 = 2u;
const STEPPED: u32 = 1u;
const FAST: u32 = 2u;
const STIRRED: u32 = 4u;
// What the tile of a block asleep is filled for, as bits: the finest level's step [s], 0 if it is not filled; and what part of gravity there was.
const FILLED: u32 = 3u;
const FILLED_GRAVITY: u32 = 4u;
// The block's mass if it sleeps, or 0 if that is not known; and that, times gravity's part, summed over steps asleep: [kg].
const MASS: u32 = 5u;
const SLEPT: u32 = 6u;
// How often it fell asleep, and what that took: momentum [N s] and kinetic energy [J].
const FELL: u32 = 7u;
const LOST: u32 = 8u;

const ASLEEP: u32 = 0xffffu;

fn watch_word(b: u32, k: u32) -> u32 {
    return b * WATCHED + k;
}

// Behind those of blocks: does anyone awake, or another layer, touch a node block?
fn touched_word(g: u32) -> u32 {
    return extent.block_room * WATCHED + g;
}

fn is_asleep(b: u32) -> bool {
    return atomicLoad(&watch[watch_word(b, RESTS)]) == ASLEEP;
}

// Notes what has happened to a block; nobody queues to change nothing.
fn note_happened(b: u32, bits: u32) {
    let word = watch_word(b, HAPPENED);
    if (atomicLoad(&watch[word]) & bits) != bits {
        atomicOr(&watch[word], bits);
    }
}
