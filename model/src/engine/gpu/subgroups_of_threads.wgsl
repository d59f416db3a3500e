// As subgroups_of_any_size.wgsl, where threads take the place of the units: as two subgroups of 32, or where
// IN_ONE_SUBGROUP as one of 64, whose halves do the same.

struct Invocation {
    @builtin(workgroup_id) workgroup: vec3u,
    @builtin(local_invocation_index) index: u32,
}

fn is_own(at: Invocation, share: u32) -> bool {
    return IN_ONE_SUBGROUP || share % 2u == at.index / 32u;
}
