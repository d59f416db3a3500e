// The panel's pixels behind one sample of the half-band grid, as blocks.rs has them. Before this file: FRAME_WIDTH and
// FRAME_HEIGHT.

const BLOCK = 4u;

// Where a plane of the frame has pixel `corner` of block (x, y), counted along rows; one of odd size repeats its edge.
fn block_pixel(x: u32, y: u32, corner: u32) -> u32 {
    return min(2u * y + corner / 2u, FRAME_HEIGHT - 1u) * FRAME_WIDTH + min(2u * x + corner % 2u, FRAME_WIDTH - 1u);
}
