// What an eye should see at each depth layer, as the map `inputs` that both nets read has it. Before this file:
// STACK_GROUP, Amplitude, and what that map declares as `input`.

// The amplitude of channel 3·layer + colour.
fn expected(channel: u32, x: u32, y: u32) -> f32 {
    // What the map has of -0.4 stands for exact black.
    let black = f32(input_vector(vec4f(-0.4f)).x);
    return f32(inputs[input_place(STACK_GROUP + channel / 4u, x, y)][channel % 4u]) - black;
}
