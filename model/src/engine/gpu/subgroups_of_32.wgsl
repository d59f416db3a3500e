// Of a workgroup of 32 threads, which is a subgroup. Before this file: THREADS.

struct Invocation {
    @builtin(workgroup_id) workgroup: vec3u,
    @builtin(local_invocation_index) index: u32,
}

// Whether the thread's subgroup does this share of the workgroup's products.
fn is_own(at: Invocation, share: u32) -> bool {
    return true;
}
