// What was found in a step stands for the step, and stops the submission if levels must move before the next one.
const WORDS: u32 = 27u;
const FOUND: u32 = 6u;
const LEEWAY: u32 = 12u;

fn word(at: u32, k: u32) -> vec3<i32> {
    return vec3<i32>(atomicLoad(&softs[at + k]), atomicLoad(&softs[at + k + 1u]), atomicLoad(&softs[at + k + 2u]));
}

@compute @workgroup_size(64)
fn watch_soft(@builtin(local_invocation_index) thread: u32) {
    if atomicLoad(&status[HALTED]) != 0u {
        return;
    }
    for (var i = thread; i < LAYERS / LEVELS * SOFTS; i += 64u) {
        if layers[i / SOFTS * LEVELS].on == 0u {
            continue;
        }
        let at = WORDS * i;
        let least = word(at, 0u);
        let end = word(at, 3u);
        for (var k = 0u; k < 6u; k++) {
            atomicStore(&softs[at + FOUND + k], atomicLoad(&softs[at + k]));
            atomicStore(&softs[at + k], select(-0x7fffffff - 1, 0x7fffffff, k < 3u));
        }
        // A body that has come or gone is news.
        let is_as_known = (least.x < end.x) == (word(at, LEEWAY).x != 0x7fffffff);
        let ends_fit = all(least >= word(at, LEEWAY)) && all(least <= word(at, LEEWAY + 12u)) && all(end <= word(at, LEEWAY + 3u));
        let sum = least + end;
        if !(is_as_known && ends_fit && all(sum >= word(at, LEEWAY + 6u)) && all(sum <= word(at, LEEWAY + 9u))) {
            atomicStore(&status[HALT_STEP], step.number + 1u);
            atomicStore(&status[HALTED], FOLLOW);
        }
    }
}
