// Nodes behind mirrors are images of nodes before them.

var<workgroup> given: array<vec4<f32>, 64>;

// The node that one behind mirrors is the image of, or itself. P2G folds along the first axis first: what the wall across it gives
// (`outer`), the other mirrors have turned already (`inner`).
struct Image {
    cell: vec3<i32>,
    outer: vec3<f32>,
    inner: vec3<f32>,
    is_other: bool,
}

fn image_of(layer: u32, cell: vec3<i32>) -> Image {
    let low = world_min(layer);
    let high = world_max(layer);
    var image = Image(cell, vec3<f32>(1.0), vec3<f32>(1.0), false);
    for (var axis = 0; axis < 3; axis++) {
        for (var end = 0; end < 2; end++) {
            let kind = select(LOW[axis], HIGH[axis], end == 1);
            let beyond = select(cell[axis] < low[axis], cell[axis] >= high[axis], end == 1);
            if kind != 0u && beyond {
                if image.is_other {
                    image.inner *= wall_signs(kind, axis);
                } else {
                    image.outer = wall_signs(kind, axis);
                }
                image.is_other = true;
                image.cell[axis] = 2 * select(low[axis], high[axis], end == 1) - 1 - cell[axis];
            }
        }
    }
    return image;
}

// What the wall gives to the mass behind it that comes to move with velocity `u`, turned by the wall [N s].
fn given_behind(image: Image, u: vec3<f32>, mass: f32) -> vec3<f32> {
    return (image.outer - vec3<f32>(1.0)) * u * mass;
}

// The sum over a block's nodes, for the first thread.
fn sum_of_block(n: u32, impulse: vec3<f32>) -> vec4<f32> {
    given[n] = vec4<f32>(impulse, 0.0);
    workgroupBarrier();
    if n < 8u {
        for (var t = 1u; t < 8u; t++) {
            given[n] += given[n + 8u * t];
        }
    }
    workgroupBarrier();
    var total = vec4<f32>(0.0);
    if n == 0u {
        for (var t = 0u; t < 8u; t++) {
            total += given[t];
        }
    }
    return total;
}
