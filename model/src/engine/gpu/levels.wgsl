// Phases to the panel's samples, as the panel takes them. After these constants:
// THREADS (of a workgroup), PANEL_WIDTH, PANEL_HEIGHT, WIDTH, HEIGHT, LEFT, TOP, MIRROR_X, MIRROR_Y (whether a pattern's
// columns and rows run the other way), INTERLEAVED, FIRST, SECOND, THIRD (colours in the order shown), ENTRIES (of a
// colour's table), FLATNESS (whether there is any).

@group(0) @binding(0) var<storage, read> phases_rad: array<f32>; // [3, height, width]
@group(0) @binding(1) var<storage, read> level_of_phase: array<u32>; // [3, entries]
@group(0) @binding(2) var<storage, read> flatness: array<f32>; // [3, panel height, panel width], in entries
@group(0) @binding(3) var<storage, read_write> samples: array<u32>; // two to each
@group(0) @binding(4) var<storage, read_write> unreachable_samples: array<atomic<u32>, 3>;

const PIXELS: u32 = PANEL_WIDTH * PANEL_HEIGHT;
const ENTRIES_PER_RAD: f32 = f32(ENTRIES) / 6.28318530717959;
const UNREACHABLE: u32 = 1 << 16;

var<workgroup> unreachable: array<atomic<u32>, 3>;

fn sample(index: u32) -> u32 {
    var position = index / PIXELS;
    var pixel = index % PIXELS;
    if INTERLEAVED {
        position = index % 3u;
        pixel = index / 3u;
    }
    let colour = select(select(THIRD, SECOND, position == 1u), FIRST, position == 0u);
    // Above and left of the pattern these wrap round to what is too large.
    let column = pixel % PANEL_WIDTH - LEFT;
    let row = pixel / PANEL_WIDTH - TOP;
    let x = select(column, WIDTH - 1u - column, MIRROR_X);
    let y = select(row, HEIGHT - 1u - row, MIRROR_Y);
    let inside = x < WIDTH && y < HEIGHT;
    // Around it what double phase makes of no light: π/2 where x + y is odd, -π/2 where it is even.
    var entries = f32(ENTRIES) * select(0.75, 0.25, (x + y) % 2u == 1u);
    if inside {
        entries = phases_rad[(colour * HEIGHT + y) * WIDTH + x] * ENTRIES_PER_RAD;
    }
    if FLATNESS {
        entries += flatness[colour * PIXELS + pixel];
    }
    let entry = bitcast<u32>(i32(floor(entries))) & (ENTRIES - 1u);
    let level = level_of_phase[colour * ENTRIES + entry];
    if inside && level >= UNREACHABLE {
        atomicAdd(&unreachable[colour], 1u);
    }
    return level & 0xffffu;
}

@compute @workgroup_size(THREADS)
fn levels(
    @builtin(workgroup_id) part: vec3u,
    @builtin(num_workgroups) parts: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let index = (part.y * parts.x + part.x) * THREADS + thread;
    if 2u * index < 3u * PIXELS {
        let first = sample(2u * index);
        var second = 0u;
        if 2u * index + 1u < 3u * PIXELS {
            second = sample(2u * index + 1u);
        }
        samples[index] = first | (second << 16u);
    }
    workgroupBarrier();
    if thread < 3u {
        let count = atomicLoad(&unreachable[thread]);
        if count > 0u {
            atomicAdd(&unreachable_samples[thread], count);
        }
    }
}
