//! Generations of random scenes: what cards and marks are drawn from.

use std::ops::Range;

use holod_model::scene_shard::SceneKind;

use super::random::{Random, mix, stream};

/// Cards and marks of the shipped networks' recipe, `model/weights/recipe.md`: kind, seed and indices. They stay as they
/// were when these networks learnt from them and were judged on them.
const RECIPE: [(SceneKind, u64, Range<u64>); 4] = [
    (SceneKind::Cards, 2, 1000..1080),
    (SceneKind::Cards, 7, 0..2),
    (SceneKind::Marks, 2, 4000..4264),
    (SceneKind::Marks, 9001, 0..6),
];

/// The generation of a random scene: the same kind, seed and index give the same scene within one generation only.
/// Shards that name none are of the first.
///
/// In the second, seed and index of cards and marks were one number, so that those of another seed were the same with
/// other indices, held-out ones and those for training, too. In the third each has its own, but for those of the recipe
/// of the shipped networks.
pub fn generator(kind: SceneKind, seed: u64, index: u64) -> u32 {
    if matches!(kind, SceneKind::Cards | SceneKind::Marks) && !is_of_recipe(kind, seed, index) { 3 } else { 2 }
}

fn is_of_recipe(kind: SceneKind, seed: u64, index: u64) -> bool {
    RECIPE.iter().any(|(of, with, indices)| *of == kind && *with == seed && indices.contains(&index))
}

/// What is on the cards, or the marks, of a scene.
///
/// # Panics
/// Of other kinds.
pub(super) fn drawn(kind: SceneKind, seed: u64, index: u64) -> Random {
    let of_recipe = is_of_recipe(kind, seed, index);
    match kind {
        SceneKind::Cards if of_recipe => {
            Random::new(mix(seed ^ (index / 2)) ^ stream(kind), u64::from(index.is_multiple_of(2)))
        }
        SceneKind::Marks if of_recipe => Random::new(mix(seed ^ (index / 3)) ^ stream(kind), index % 3),
        // Mixed twice: once is another seed's of the recipe.
        SceneKind::Cards | SceneKind::Marks => Random::new(mix(mix(seed)) ^ stream(kind), index),
        SceneKind::Train | SceneKind::Test => unreachable!("they are drawn as a whole"),
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashMap;

    use super::*;

    fn first_two(kind: SceneKind, seed: u64, index: u64) -> [u32; 2] {
        let mut drawn = drawn(kind, seed, index);
        [drawn.seed(), drawn.seed()]
    }

    #[test]
    fn no_two_seeds_and_indices_give_the_same_cards_or_marks() {
        for kind in [SceneKind::Cards, SceneKind::Marks] {
            let recipe = RECIPE.into_iter().filter(|(of, ..)| *of == kind);
            let recipe = recipe.flat_map(|(_, seed, indices)| indices.map(move |index| (seed, index)));
            let seeds = (0..16).chain([9000, 9001, 9002]).chain(500..504).chain(1332..1336);
            let others = seeds.flat_map(|seed| (0..64).chain(998..1090).map(move |index| (seed, index)));
            let mut seen = HashMap::new();
            for of in recipe.chain(others) {
                let before = seen.insert(first_two(kind, of.0, of.1), of);
                assert!(before.is_none_or(|before| before == of), "{kind:?} {of:?} as {before:?}");
            }
        }
    }

    #[test]
    fn the_recipes_cards_and_marks_are_as_they_were() {
        for ((kind, seed, index), expected) in [
            ((SceneKind::Cards, 7, 0), [0xcdcc_5e94, 0xcf8f_fdbc]),
            ((SceneKind::Cards, 7, 1), [0x22ee_ff39, 0xfd2a_c31e]),
            ((SceneKind::Cards, 2, 1079), [0x855b_fc34, 0x69ab_3933]),
            ((SceneKind::Marks, 9001, 0), [0x4a59_6f38, 0x940c_671b]),
            ((SceneKind::Marks, 9001, 5), [0x5519_e409, 0xff2d_b8a0]),
            ((SceneKind::Marks, 2, 4263), [0x69c6_de80, 0xf2aa_31bd]),
        ] {
            assert_eq!(first_two(kind, seed, index), expected, "{kind:?} {seed} {index}");
            assert_eq!(generator(kind, seed, index), 2);
        }
        assert_eq!(generator(SceneKind::Cards, 7, 2), 3);
        assert_eq!(generator(SceneKind::Marks, 7, 0), 3);
        assert_eq!((generator(SceneKind::Train, 7, 2), generator(SceneKind::Test, 9001, 0)), (2, 2));
    }
}
