// Must particles be sorted before the step, so many steps after their last sort, if they may have drifted by so much since then [cells]? As
// `is_sort_due` in `due.rs`.
fn is_sort_due(age: u32, drift: f32) -> bool {
    return !(drift <= MAX_DRIFT) || any((vec3<u32>(age) % SORT_EVERY == vec3<u32>(0u)) & (vec3<f32>(drift) > SORT_DRIFT));
}
