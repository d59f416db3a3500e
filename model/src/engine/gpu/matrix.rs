//! Shaders that multiply matrices, and how their weights lie.

use super::map::{Format, GROUP, Map, ROWS, TILE};
use super::plan::ENABLE_F16;
use crate::gpu::MatrixUnits;

/// Blocks of output channels that a workgroup makes.
const PART_BLOCKS: usize = 2;

/// How the parameters of a layer lie in their buffer, in half precision: the bias of each output, then the weights as
/// [part, what the layer goes through, output block of the part, input channel, output].
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct TilePacking {
    pub(super) parts: usize,
    /// Pairs of matrices of weights in a part.
    steps: usize,
    /// Whether the inputs of each output lie together.
    by_output: bool,
}

impl TilePacking {
    /// Of a layer that writes `output_groups` on `units` and goes through `steps` pairs of matrices for each part.
    pub(super) fn new(units: MatrixUnits, output_groups: usize, steps: usize) -> Self {
        let by_output = weights_by_output(units);
        Self { parts: (output_groups * GROUP).div_ceil(PART_BLOCKS * TILE), steps, by_output }
    }

    pub(super) fn len(self) -> usize {
        self.biases() * (1 + self.steps * TILE)
    }

    /// Numbers before the weights.
    pub(super) fn biases(self) -> usize {
        self.parts * PART_BLOCKS * TILE
    }

    /// The place of the weight at `step` for one input of its block.
    pub(super) fn place(self, output: usize, step: usize, input: usize) -> usize {
        let (part, block) = (output / TILE / PART_BLOCKS, output / TILE % PART_BLOCKS);
        let matrix = (part * self.steps + step) * PART_BLOCKS + block;
        let (input, output) = (input % TILE, output % TILE);
        let (row, column) = if self.by_output { (output, input) } else { (input, output) };
        (self.parts * PART_BLOCKS + matrix * TILE + row) * TILE + column
    }
}

/// Rows that a workgroup makes of a plain layer.
pub(super) fn rows(units: MatrixUnits) -> usize {
    match units {
        MatrixUnits::Device => 3,
        MatrixUnits::DeviceOfAnySubgroups => ROWS,
        // More would be compiled for many seconds.
        #[cfg(test)]
        MatrixUnits::Threads => 2,
        #[cfg(test)]
        MatrixUnits::ThreadsOfAnySubgroups { .. } => ROWS,
    }
}

/// Whether a plain layer makes half of the products, as [`winograd`](super::winograd) does. Cards of RDNA 3 do so: their
/// units take longer for all of the products than their memory for the maps.
pub(super) fn by_points(units: MatrixUnits) -> bool {
    units.of_any_subgroups()
}

/// Whether the inputs of each output lie together. Cards of RDNA 3 hold them in one thread, and read them at once.
fn weights_by_output(units: MatrixUnits) -> bool {
    units.of_any_subgroups()
}

/// A shader that multiplies on `units` the pixels that lie in `memory`, for workgroups of `rows`.
pub(super) fn source(output: &Map, units: MatrixUnits, memory: &str, rows: usize, files: &[&str]) -> String {
    const EXTENSION: &str = "enable wgpu_cooperative_matrix;\n";
    const PRODUCTS: &str = include_str!("matrix_units.wgsl");
    let (extension, products, subgroups) = match units {
        MatrixUnits::Device => (EXTENSION, PRODUCTS, include_str!("subgroups_of_32.wgsl").to_owned()),
        MatrixUnits::DeviceOfAnySubgroups => {
            (EXTENSION, PRODUCTS, include_str!("subgroups_of_any_size.wgsl").to_owned())
        }
        #[cfg(test)]
        MatrixUnits::Threads => {
            ("", include_str!("matrix_threads.wgsl"), include_str!("subgroups_of_32.wgsl").to_owned())
        }
        #[cfg(test)]
        MatrixUnits::ThreadsOfAnySubgroups { in_one } => {
            let how = format!("const IN_ONE_SUBGROUP = {in_one};\n{}", include_str!("subgroups_of_threads.wgsl"));
            ("", include_str!("matrix_threads.wgsl"), how)
        }
    };
    let threads = if units.of_any_subgroups() { 64 } else { 32 };
    let mut constants =
        format!("const THREADS = {threads}u;\nconst WEIGHTS_BY_OUTPUT = {};\n", weights_by_output(units));
    let store = match output.format {
        Format::Single | Format::Half => {
            constants.push_str(&format!("alias OutVector = {};\n", output.format.precision().vector()));
            include_str!("store_groups.wgsl")
        }
        Format::HalfTiles(_) => include_str!("store_tile.wgsl"),
    };
    let text = [
        &constants,
        include_str!("epilogue.wgsl"),
        store,
        &subgroups,
        &products.replace("MEMORY", memory),
        include_str!("finish_matrix.wgsl"),
        &files.concat(),
    ];
    let counts = [("row", rows), ("line", rows + 2), ("tap", 3), ("block", PART_BLOCKS)];
    format!("{ENABLE_F16}{extension}var<private> lane: u32;\n\n{}", unrolled(&text.join("\n"), &counts))
}

/// `text` with each line `each NAME, …: REST` in the form of REST once for all values below each name's count, the last
/// name's changing first, with `{NAME}` and `{NAME+NAME}` in it replaced.
fn unrolled(text: &str, counts: &[(&str, usize)]) -> String {
    let mut all = String::new();
    for line in text.lines() {
        let Some((names, rest)) = line.trim_start().strip_prefix("each ").and_then(|line| line.split_once(": ")) else {
            all.push_str(line);
            all.push('\n');
            continue;
        };
        let names: Vec<_> = names.split(", ").collect();
        let count = |name: &str| counts.iter().find(|(known, _)| *known == name).expect("a name that is counted").1;
        for index in 0..names.iter().map(|name| count(name)).product() {
            let mut values = Vec::new();
            let mut left = index;
            for name in names.iter().rev() {
                values.push((*name, left % count(name)));
                left /= count(name);
            }
            let mut line = rest.to_owned();
            for &(name, value) in &values {
                line = line.replace(&format!("{{{name}}}"), &value.to_string());
                for &(other, more) in &values {
                    line = line.replace(&format!("{{{name}+{other}}}"), &(value + more).to_string());
                }
            }
            all.push_str(&line);
            all.push('\n');
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_written_for_all_values_of_their_names() {
        let text = "let a = 1;\n    each row, tap: s{row} = f(p{row+tap}, w{tap});\nend";
        let expected = "let a = 1;\ns0 = f(p0, w0);\ns0 = f(p1, w1);\ns1 = f(p1, w0);\ns1 = f(p2, w1);\nend\n";
        assert_eq!(unrolled(text, &[("row", 2), ("tap", 2)]), expected);
    }

    #[test]
    fn every_weight_has_a_place_of_its_own_behind_the_biases() {
        for units in [MatrixUnits::Device, MatrixUnits::DeviceOfAnySubgroups] {
            let packing = TilePacking::new(units, 12, 3);
            let mut places: Vec<_> = (0..48)
                .flat_map(|output| (0..3 * TILE).map(move |input| packing.place(output, input / TILE, input)))
                .collect();
            places.sort_unstable();
            places.dedup();
            assert_eq!((places.len(), places[0], packing.parts), (48 * 3 * TILE, 64, 2));
            assert!(*places.last().expect("places") < packing.len());
        }
    }
}
