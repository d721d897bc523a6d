// A body as the pass of pressing particles needs it: the nodes that it may reach, where it is, the rows of its rotation, and its number.
struct PressedBody { least: vec3<i32>, most: vec3<i32>, cell: vec3<i32>, place: vec3<f32>, rows: array<vec3<f32>, 3>, number: u32 }

