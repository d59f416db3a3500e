// What an eye should see at each depth layer, as the map `inputs` that both nets read has it. Before this file:
// STACK_GROUP and what that map declares as `input`.

// The amplitude of channel 3·layer + colour.
fn expected(channel: u32, x: u32, y: u32) -> f32 {
    return f32(inputs[input_place(STACK_GROUP + channel / 4u, x, y)][channel % 4u]) + 0.4f;
}
