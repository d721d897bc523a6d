// No body answers: a node is the driven one's in which it is deepest.
fn keeper(owner: u32, distance: f32, first: vec3<i32>, g: u32, n: u32) -> u32 {
    return owner;
}
