// As subgroups_of_32.wgsl, of a workgroup of 64 threads, which is one subgroup or two: that is left to the driver.

struct Invocation {
    @builtin(workgroup_id) workgroup: vec3u,
    @builtin(local_invocation_index) index: u32,
    @builtin(subgroup_id) subgroup: u32,
    // Drivers know it as they compile, so that no branch is left.
    @builtin(subgroup_size) size: u32,
}

fn is_own(at: Invocation, share: u32) -> bool {
    return at.size == 64u || share % 2u == at.subgroup;
}
