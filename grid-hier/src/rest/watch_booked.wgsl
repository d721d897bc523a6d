
// Books the last step of a block that was asleep in it.
fn book_sleep(b: u32) {
    let happened = watch_word(b, HAPPENED);
    if is_asleep(b) && (atomicLoad(&watch[happened]) & STEPPED) != 0u {
        let weighs = bitcast<f32>(atomicLoad(&watch[watch_word(b, MASS)])) * bitcast<f32>(atomicLoad(&watch[watch_word(b, FILLED_GRAVITY)]));
        let slept = watch_word(b, SLEPT);
        atomicStore(&watch[slept], bitcast<u32>(bitcast<f32>(atomicLoad(&watch[slept])) + weighs));
        atomicAnd(&watch[happened], ~STEPPED);
    }
}
