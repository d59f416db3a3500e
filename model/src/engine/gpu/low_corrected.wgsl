// The field on the network's grid as the `expected-stack` family has it: what the second net reads of it, and a share
// of what that gives. Before this file: FIELD_GROUP, CORRECTION_SHARE and what both maps declare.

// Each has three real parts and three imaginary ones in two groups.
@group(0) @binding(1) var<storage, read> inputs: array<input_vector>;
@group(0) @binding(2) var<storage, read> correction: array<correction_vector>;

fn corrected(group: u32, x: u32, y: u32) -> vec4f {
    let added = vec4f(correction[correction_place(group, x, y)]);
    return vec4f(inputs[input_place(FIELD_GROUP + group, x, y)]) + CORRECTION_SHARE * added;
}

// All colours of sample (x, y).
fn low(x: u32, y: u32) -> array<vec2f, 3> {
    let head = corrected(0u, x, y);
    let tail = corrected(1u, x, y);
    return array(vec2f(head.x, head.w), vec2f(head.y, tail.x), vec2f(head.z, tail.y));
}
