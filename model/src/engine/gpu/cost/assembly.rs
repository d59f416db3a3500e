//! What a card is kept busy with by a shader, read off its instructions.

/// Trip counts and kinds of a shader's instructions, in the order in which they lie.
pub(super) struct Assembly {
    instructions: Vec<Instruction>,
    loops: Vec<Loop>,
}

#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Instruction {
    /// Vector operations: 1, 2 where two are issued together, or 0.
    vector: u32,
    /// How many of those are multiply-adds.
    multiply_adds: u32,
    /// Cycles for which a wave of 32 threads keeps its SIMD's vector port; those of a wave of 64 are twice as many, but
    /// for products of matrices.
    passes: u32,
    matrix: bool,
    /// Bytes that each thread reads or writes in the workgroup's memory.
    workgroup_bytes: u32,
}

/// Instructions that are run again and again.
#[derive(Clone, Debug, PartialEq)]
struct Loop {
    first: usize,
    end: usize,
    /// How often, where the limits are constants.
    trips: Option<u64>,
}

/// What one wave does from begin to end.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Work {
    /// Cycles for which it keeps its SIMD's vector port.
    pub(super) vector_cycles: u64,
    /// Bytes that its threads read or write in the workgroup's memory.
    pub(super) workgroup_bytes: u64,
}

/// The loop, or the whole of a shader without one, in which a wave spends most of its time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct HotLoop {
    /// Vector operations of one trip.
    pub(super) vector: u32,
    /// How many of them are multiply-adds.
    pub(super) multiply_adds: u32,
}

impl HotLoop {
    pub(super) fn multiply_add_share(&self) -> f64 {
        f64::from(self.multiply_adds) / f64::from(self.vector.max(1))
    }
}

/// A line of assembly.
enum Line<'a> {
    Label(&'a str),
    /// The name and the operands of each of the operations that it issues, one or two.
    Operations(Vec<(&'a str, Vec<&'a str>)>),
}

fn lines(text: &str) -> impl Iterator<Item = Line<'_>> {
    text.lines().filter_map(|line| {
        let line = line.split(';').next().unwrap_or_default().trim();
        if let Some(label) = line.strip_suffix(':') {
            return Some(Line::Label(label));
        }
        let operations: Vec<_> = line.split("::").filter_map(operation).collect();
        (!operations.is_empty()).then_some(Line::Operations(operations))
    })
}

/// The name and the operands of an operation.
fn operation(text: &str) -> Option<(&str, Vec<&str>)> {
    let (name, operands) = text.trim().split_once(char::is_whitespace).unwrap_or((text.trim(), ""));
    let known = name.starts_with(|c: char| c.is_ascii_lowercase());
    known.then(|| (name, operands.split(',').map(str::trim).filter(|operand| !operand.is_empty()).collect()))
}

impl Assembly {
    pub(super) fn new(text: &str) -> Self {
        let mut operations = Vec::new();
        let mut labels = Vec::new();
        for line in lines(text) {
            match line {
                Line::Label(label) => labels.push((label, operations.len())),
                Line::Operations(line) => operations.push(line),
            }
        }
        let place = |label: &str| labels.iter().find(|(found, _)| *found == label).map(|(_, place)| *place);
        let mut loops = Vec::<Loop>::new();
        for (index, line) in operations.iter().enumerate() {
            let [(name, operands)] = line.as_slice() else { continue };
            let target = operands.last().and_then(|operand| place(operand));
            let Some(first) = target.filter(|&target| name.contains("branch") && target <= index) else { continue };
            match loops.iter_mut().find(|found| found.first == first) {
                Some(found) => found.end = index + 1,
                None => loops.push(Loop { first, end: index + 1, trips: None }),
            }
        }
        for number in 0..loops.len() {
            let inside = |index: usize| innermost(&loops, index) == Some(number);
            loops[number].trips =
                Counter { operations: &operations, place: &place, inside: &inside }.trips(&loops[number]);
        }
        Self { instructions: operations.iter().map(|line| Instruction::new(line)).collect(), loops }
    }

    /// Whether there is any instruction for the vector port: a driver without a disassembler shows none.
    pub(super) fn is_empty(&self) -> bool {
        self.instructions.iter().all(|instruction| instruction.vector == 0)
    }

    /// What a wave of `threads` does, unless a loop's trips are not known. Branches that go forward are not taken.
    pub(super) fn work(&self, threads: u32) -> Option<Work> {
        let mut work = Work::default();
        for (index, instruction) in self.instructions.iter().enumerate() {
            let times = self.times(index)?;
            work.vector_cycles += times * u64::from(instruction.cycles(threads));
            work.workgroup_bytes += times * u64::from(instruction.workgroup_bytes * threads);
        }
        Some(work)
    }

    /// How often an instruction is run.
    fn times(&self, index: usize) -> Option<u64> {
        self.loops.iter().filter(|found| found.contains(index)).map(|found| found.trips).product()
    }

    /// What is found if the trips that are not known are taken as one.
    pub(super) fn hot_loop(&self) -> HotLoop {
        let body = |number: Option<usize>| {
            let all = 0..self.instructions.len();
            let inside: Vec<_> = all.filter(|&index| innermost(&self.loops, index) == number).collect();
            let total = |value: fn(&Instruction) -> u32| inside.iter().map(|&at| value(&self.instructions[at])).sum();
            let times: u64 = inside.first().map_or(1, |&first| {
                self.loops.iter().filter(|found| found.contains(first)).map(|found| found.trips.unwrap_or(1)).product()
            });
            let cycles: u32 = total(|instruction| instruction.passes);
            let hot =
                HotLoop { vector: total(|found| found.vector), multiply_adds: total(|found| found.multiply_adds) };
            (times * u64::from(cycles), hot)
        };
        let bodies = (0..self.loops.len()).map(|number| body(Some(number))).chain([body(None)]);
        bodies.max_by_key(|(cycles, _)| *cycles).expect("there is the whole").1
    }
}

impl Loop {
    fn contains(&self, index: usize) -> bool {
        (self.first..self.end).contains(&index)
    }
}

/// The smallest loop around an instruction.
fn innermost(loops: &[Loop], index: usize) -> Option<usize> {
    let around = loops.iter().enumerate().filter(|(_, found)| found.contains(index));
    around.min_by_key(|(_, found)| found.end - found.first).map(|(number, _)| number)
}

impl Instruction {
    fn new(operations: &[(&str, Vec<&str>)]) -> Self {
        let mut instruction = Self::default();
        for (name, _) in operations {
            if let Some(operation) = name.strip_prefix("v_") {
                let operation = operation.strip_prefix("dual_").unwrap_or(operation);
                instruction.vector += 1;
                instruction.multiply_adds += u32::from(is_multiply_add(operation));
                instruction.matrix |= operation.starts_with("wmma");
                // Two that are issued together take the time of one.
                instruction.passes = instruction.passes.max(passes(operation));
            } else if name.starts_with("ds_") {
                instruction.workgroup_bytes += workgroup_bytes(name);
            }
        }
        instruction
    }

    fn cycles(&self, threads: u32) -> u32 {
        if self.matrix { self.passes } else { self.passes * threads.div_ceil(32) }
    }
}

/// Those of integers make places, and are no work.
fn is_multiply_add(operation: &str) -> bool {
    let families = ["fma", "mac_f", "mad_f", "pk_fma", "dot", "wmma"];
    families.iter().any(|family| operation.starts_with(family))
}

/// As AMD's papers on both architectures and Mesa's estimate have them.
///
/// A product of matrices of 16 by 16 by 16 numbers is 2·16³ = 8192 operations. An RX 7900 XTX is said to make 123
/// TFLOP/s of them: at 2.5 GHz 512 a cycle in each of its 96 compute units, 256 in each SIMD, which is 32 cycles for
/// one, whether 32 threads hold it or 64.
fn passes(operation: &str) -> u32 {
    let begins = |with: &[&str]| with.iter().any(|name| operation.starts_with(name));
    if begins(&["wmma_i32_16x16x16_iu4"]) {
        16
    } else if begins(&["wmma"]) {
        32
    } else if operation.contains("_f64") {
        16
    } else if begins(&["rcp_", "rsq_", "sqrt_", "exp_", "log_", "sin_", "cos_"])
        || begins(&["mul_lo_u32", "mul_lo_i32", "mul_hi_u32", "mul_hi_i32", "mad_u64_u32", "mad_i64_i32"])
    {
        4
    } else if operation.contains("b64") || operation.contains("_u64") || operation.contains("_i64") {
        2
    } else {
        1
    }
}

fn workgroup_bytes(name: &str) -> u32 {
    let sizes = [("b128", 16), ("b96", 12), ("b64", 8), ("b32", 4), ("u32", 4), ("16", 2), ("8", 1)];
    let size = sizes.iter().find(|(part, _)| name.contains(part)).map_or(4, |(_, size)| *size);
    let places = if name.contains("2addr") || name.contains("read2") || name.contains("write2") { 2 } else { 1 };
    size * places
}

/// Finds how often a loop is run whose counter begins, steps and ends at constants.
struct Counter<'a> {
    operations: &'a [Vec<(&'a str, Vec<&'a str>)>],
    place: &'a dyn Fn(&str) -> Option<usize>,
    /// Whether an instruction belongs to the loop, and to none inside of it.
    inside: &'a dyn Fn(usize) -> bool,
}

impl Counter<'_> {
    fn trips(&self, body: &Loop) -> Option<u64> {
        let own = || (body.first..body.end).filter(|&index| (self.inside)(index));
        own().find_map(|index| {
            let (name, operands) = self.single(index)?;
            let target = (self.place)(operands.last()?)?;
            let taken_on = match name.strip_prefix("s_cbranch_")? {
                "scc1" => true,
                // Threads whose condition is false are switched off, and the loop is left when none is on.
                "scc0" | "execz" => false,
                _ => return None,
            };
            let leaves_on = match target {
                _ if !body.contains(target) => taken_on,
                _ if target == body.first && index + 1 == body.end => !taken_on,
                _ => return None,
            };
            let compares = |index: &usize| self.single(*index).is_some_and(|(name, _)| comparison(name).is_some());
            let compare = (body.first..index).rev().find(compares)?;
            // Threads whose condition is true are taken out of those that go on; the loop is left when there are none.
            let takes_out = (compare..index).any(|index| {
                let found = self.single(index);
                found.is_some_and(|(name, operands)| {
                    let removes = name.starts_with("s_and_not1_b") || name.starts_with("s_andn2_b");
                    removes && operands.last().is_some_and(|operand| operand.starts_with("exec"))
                })
            });
            self.count(body, compare, leaves_on ^ takes_out)
        })
    }

    /// Trips of a loop that is left where the comparison gives `leaves_on`.
    fn count(&self, body: &Loop, compare: usize, leaves_on: bool) -> Option<u64> {
        let (name, operands) = self.single(compare)?;
        let relation = comparison(name)?;
        let [left, right] = operands.last_chunk::<2>()?;
        let (register, limit, swapped) = match (number(left), number(right)) {
            (None, Some(limit)) => (*left, limit, false),
            (Some(limit), None) => (*right, limit, true),
            _ => return None,
        };
        let vector = register.starts_with('v');
        let writes = |index: &usize| {
            let found = self.single(*index);
            found.is_some_and(|(name, operands)| operands.first() == Some(&register) && comparison(name).is_none())
        };
        let before = (0..body.first).rev().find(writes).and_then(|index| {
            let (name, operands) = self.single(index)?;
            if name.contains("mov") { number(operands.get(1)?) } else { None }
        });
        // A vector begins at the thread's number, which is less than a step.
        let begin = before.or(vector.then_some(0))?;
        let step = (body.first..body.end).rev().find(writes).and_then(|index| self.step(index))?;
        let goes_on_while = match (relation, leaves_on) {
            ("lt", false) | ("ge", true) => "lt",
            ("le", false) | ("gt", true) => "le",
            ("gt", false) | ("le", true) => "gt",
            ("ge", false) | ("lt", true) => "ge",
            ("lg" | "ne", false) | ("eq", true) => "ne",
            _ => return None,
        };
        let goes_on_while = match (goes_on_while, swapped) {
            ("lt", true) => "gt",
            ("gt", true) => "lt",
            ("le", true) => "ge",
            ("ge", true) => "le",
            (relation, _) => relation,
        };
        let distance = match goes_on_while {
            "lt" => limit - begin,
            "ne" => (limit - begin).abs(),
            "gt" => begin - limit,
            "le" => limit + 1 - begin,
            _ => begin + 1 - limit,
        };
        u64::try_from(distance.signum() * (distance.abs() + step.abs() - 1) / step.abs()).ok()
    }

    /// What an addition of a constant adds, except nothing.
    fn step(&self, index: usize) -> Option<i64> {
        let (name, operands) = self.single(index)?;
        let (_, addition) = name.split_once("_add").or_else(|| name.split_once("_sub"))?;
        let plain = ["_u32", "_i32", "k_i32", "_nc_u32", "_nc_u32_e32", "_nc_u32_e64"].contains(&addition);
        let step = operands[1..].iter().find_map(|operand| number(operand))?;
        (plain && step != 0).then_some(step)
    }

    fn single(&self, index: usize) -> Option<(&str, &[&str])> {
        match self.operations[index].as_slice() {
            [(name, operands)] => Some((name, operands)),
            _ => None,
        }
    }
}

/// The relation of a comparison of 32-bit integers.
fn comparison(name: &str) -> Option<&str> {
    let rest = ["s_cmpk_", "s_cmp_", "v_cmpx_", "v_cmp_"].iter().find_map(|prefix| name.strip_prefix(prefix))?;
    let (relation, kind) = rest.split_once('_')?;
    (kind.starts_with("u32") || kind.starts_with("i32")).then_some(relation)
}

fn number(operand: &str) -> Option<i64> {
    let (sign, digits) = operand.strip_prefix('-').map_or((1, operand), |digits| (-1, digits));
    let value = match digits.strip_prefix("0x") {
        Some(digits) => i64::from_str_radix(digits, 16),
        None => digits.parse(),
    };
    value.ok().map(|value| sign * value)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two loops, the inner one of three multiply-adds in four vector operations; after them a transcendental function.
    const NESTED: &str = "BB0:
\ts_mov_b32 s12, 0                                            ; be8c0080
\tv_mov_b32_e32 v2, s15                                       ; 7e04020f
BB1:
\ts_cmp_ge_u32 s12, 8                                         ; bf09880c
\ts_cbranch_scc1 BB5                                          ; bfa20bba
BB2:
\ts_mov_b32 s13, 0                                            ; be8d0080
BB3:
\tbuffer_load_b128 v[72:75], v66, s[16:19], 0 offen           ; e05c0000 80444842
\ts_waitcnt vmcnt(0)                                          ; bf8903f7
\tv_fmac_f32_e32 v5, s20, v72                                 ; 560a9014
\tv_fmac_f32_e32 v4, s21, v72                                 ; 56089015
\tv_fma_f32 v4, s21, v72, v4                                  ; 56089015
\tv_mad_u32_u24 v1, s30, v1, v0                               ; 4a02021e
\tds_load_b64 v[0:1], v3                                      ; d9d80000
(invalid instruction)                                        ; f4281a04
\ts_add_u32 s13, s13, 2                                       ; 800c811f
\ts_cmp_lt_u32 s13, 5                                         ; bf0a850d
\ts_cbranch_scc1 BB3                                          ; bfa20bba
BB4:
\ts_cbranch_scc0 BB4b                                         ; bfa10000
BB4b:
\ts_xor_b32 s31, s31, s12                                     ; 8d1f0c1f
\ts_add_i32 s12, s31, 1                                       ; 800c811f
\ts_branch BB1                                                ; bfa0f444
BB5:
\tv_exp_f32_e32 v1, v1                                        ; 7e024b01
\tv_add_f64 v[0:1], v[2:3], v[4:5]                            ; 7e024b01
\ts_endpgm                                                    ; bfb00000
";

    #[test]
    fn loops_and_their_trips_are_found() {
        let assembly = Assembly::new(NESTED);
        let trips: Vec<_> = assembly.loops.iter().map(|found| found.trips).collect();
        // The inner one ends at its foot, by a branch back that is not taken.
        assert_eq!(trips, [Some(3), Some(8)]);
        assert_eq!(assembly.hot_loop(), HotLoop { vector: 4, multiply_adds: 3 });
        let per_pass = 1 + 8 * 3 * 4 + 4 + 16;
        let work = |threads: u64| Work { vector_cycles: threads / 32 * per_pass, workgroup_bytes: 8 * 3 * 8 * threads };
        assert_eq!(assembly.work(64), Some(work(64)));
        assert_eq!(assembly.work(32), Some(work(32)));
    }

    /// Canary: another limit, another instruction and an unknown limit are each seen.
    #[test]
    fn a_changed_program_is_another_one() {
        let work = |text: &str| Assembly::new(text).work(64);
        let changed = |from: &str, to: &str| {
            assert!(NESTED.contains(from));
            work(&NESTED.replace(from, to))
        };
        assert_ne!(changed("s_cmp_ge_u32 s12, 8", "s_cmp_ge_u32 s12, 9"), work(NESTED));
        assert_ne!(changed("v_mad_u32_u24 v1", "s_mul_i32 s1"), work(NESTED));
        assert_eq!(changed("s_cmp_ge_u32 s12, 8", "s_cmp_ge_u32 s12, s9"), None);
        assert_eq!(changed("s_add_i32 s12, s31, 1", "s_lshl_b32 s12, s31, 1"), None);
        let shares = |text: &str| Assembly::new(text).hot_loop().multiply_add_share();
        assert_ne!(shares(&NESTED.replace("v_fma_f32", "v_add_f32")), shares(NESTED));
    }

    #[test]
    fn counters_of_all_kinds_are_understood() {
        let trips = |begin: &str, compare: &str, branch: &str, step: &str| {
            let text = format!(
                "BB0:\n\t{begin}\nBB1:\n\t{compare}\n\t{branch} BB2\n\tv_nop\n\t{step}\n\ts_branch BB1\nBB2:\n\ts_endpgm\n"
            );
            let assembly = Assembly::new(&text);
            assert_eq!(assembly.loops.len(), 1);
            assembly.loops[0].trips
        };
        let up = "s_add_i32 s4, s4, 1";
        assert_eq!(trips("s_mov_b32 s4, 2", "s_cmp_gt_i32 s4, 8", "s_cbranch_scc1", up), Some(7));
        assert_eq!(
            trips("s_movk_i32 s4, 0x0", "s_cmp_lt_u32 s4, 0x200", "s_cbranch_scc0", "s_addk_i32 s4, 0x100"),
            Some(2)
        );
        assert_eq!(trips("s_mov_b32 s4, 0", "s_cmpk_eq_u32 s4, 9", "s_cbranch_scc1", "s_add_u32 s4, s4, 3"), Some(3));
        assert_eq!(trips("s_mov_b32 s4, 7", "s_cmp_lg_u32 s4, 0", "s_cbranch_scc0", "s_add_i32 s4, s4, -1"), Some(7));
        assert_eq!(trips("s_mov_b32 s4, 8", "s_cmp_lt_i32 s4, 0", "s_cbranch_scc1", "s_sub_i32 s4, s4, 2"), Some(5));
        // A thread's number, in steps of a workgroup: the last threads make one trip less.
        let lanes = ["v_and_b32_e32 v3, 0x3ff, v0", "v_cmpx_gt_u32_e32 0x12c, v3", "s_cbranch_execz"];
        assert_eq!(trips(lanes[0], lanes[1], lanes[2], "v_add_nc_u32_e32 v3, 64, v3"), Some(5));
        let removed = "s_andn2_b64 s[4:5], s[4:5], exec\n\ts_cbranch_scc0";
        let compare = "v_cmpx_le_u32_e32 0x12c, v3";
        assert_eq!(trips(lanes[0], compare, removed, "v_add_nc_u32_e32 v3, 64, v3"), Some(5));
        assert_eq!(trips("s_mov_b32 s4, s9", "s_cmp_ge_u32 s4, 8", "s_cbranch_scc1", up), None);
        assert_eq!(trips("s_mov_b32 s4, 0", "s_cmp_ge_u32 s4, s8", "s_cbranch_scc1", up), None);
    }

    #[test]
    fn operations_that_are_issued_together_take_the_time_of_one() {
        let pair = "BB0:\n\tv_dual_fmac_f32 v1, s2, v3 :: v_dual_mov_b32 v4, v5  ; c8\n\ts_endpgm\n";
        let assembly = Assembly::new(pair);
        assert_eq!(assembly.hot_loop(), HotLoop { vector: 2, multiply_adds: 1 });
        assert_eq!(assembly.work(32), Some(Work { vector_cycles: 1, workgroup_bytes: 0 }));
        let matrices = Assembly::new("BB0:\n\tv_wmma_f32_16x16x16_f16 v[0:7], v[8:15], v[16:23], v[0:7]\n");
        assert_eq!(matrices.work(32), matrices.work(64));
        assert_eq!(matrices.work(64), Some(Work { vector_cycles: 32, workgroup_bytes: 0 }));
        assert_eq!(matrices.hot_loop(), HotLoop { vector: 1, multiply_adds: 1 });
        assert!(!matrices.is_empty() && Assembly::new("no disassembler\n").is_empty());
    }
}
