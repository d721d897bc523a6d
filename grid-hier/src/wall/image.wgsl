// Nodes behind mirrors are images of nodes before them.

// The node that one behind mirrors is the image of, or itself. P2G folds along the first axis first: what the wall across it gives
// (`outer`), the other mirrors have turned already (`inner`).
struct Image {
    cell: vec3<i32>,
    outer: vec3<f32>,
    inner: vec3<f32>,
    is_other: bool,
}

fn image_of(layer: u32, cell: vec3<i32>) -> Image {
    let to = before_mirrors(layer, cell);
    let beyond = to != cell;
    // Axis by axis: compilers put vectors that are indexed by a variable into memory.
    let kind = select(LOW, HIGH, to < cell);
    let one = vec3<f32>(1.0);
    let x = select(one, wall_signs(kind.x, 0), beyond.x);
    let y = select(one, wall_signs(kind.y, 1), beyond.y);
    let z = select(one, wall_signs(kind.z, 2), beyond.z);
    let outer = select(select(z, y, beyond.y), x, beyond.x);
    let inner = select(select(one, z, beyond.y), y * z, beyond.x);
    return Image(to, outer, inner, any(beyond));
}

// What the wall gives to the mass behind it that comes to move with velocity `u`, turned by the wall [N s].
fn given_behind(image: Image, u: vec3<f32>, mass: f32) -> vec3<f32> {
    return (image.outer - vec3<f32>(1.0)) * u * mass;
}
