//! What holograms are made with, as reports say it.

use std::collections::BTreeMap;

use holod_calibration::Colour;
use holod_calibration::rig::Rig;
use holod_model::Weights;
use serde::Serialize;

use crate::record::hash_text;
use crate::setup;

/// The rig and its weights.
#[derive(Serialize)]
pub struct MadeWith {
    /// The network's weights by name, or their file's name.
    pub weights: String,
    /// XXH3 of 64 bits of the weights' file as it was loaded, hexadecimal; none of built-in ones.
    pub weights_xxh3: Option<String>,
    /// The rig's name, as its file gives it.
    pub rig: String,
    /// Of the rig file's text, as `holod check` states it; none of the built-in rig.
    pub rig_hash: Option<String>,
    /// XXH3 of 64 bits, hexadecimal, of each measured table that the rig file names, by its key there: the panel's
    /// look-up tables and pictures of flatness.
    pub rig_tables_xxh3: BTreeMap<String, String>,
}

impl MadeWith {
    /// What `rig` makes holograms with, whose weights were loaded; of files it says what was in them then.
    pub fn of(rig: &Rig, weights: &Weights) -> Self {
        Self {
            weights: setup::weights_name(&rig.model.weights),
            weights_xxh3: weights.file_xxh3().map(hash_text),
            rig: rig.name.clone(),
            rig_hash: rig.provenance.hash_text(),
            rig_tables_xxh3: tables_xxh3(rig),
        }
    }
}

fn tables_xxh3(rig: &Rig) -> BTreeMap<String, String> {
    let mut tables = BTreeMap::new();
    for (key, files) in [("lut_file", &rig.provenance.lut_files), ("flatness_file", &rig.provenance.flatness_files)] {
        for colour in Colour::ALL {
            if let Some(table) = &files[colour] {
                tables.insert(format!("panel.{key}.{colour}"), hash_text(table.xxh3));
            }
        }
    }
    tables
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::record::SourceFile;

    #[test]
    fn files_are_told_as_they_were_loaded() {
        let folder = tempfile::tempdir().unwrap();
        let lut = |most_rad: f64| -> String {
            (0..256).map(|level| format!("{level},{}\n", f64::from(level) * most_rad / 255.0)).collect()
        };
        let [config, table] = ["rig.toml", "green.csv"].map(|name| folder.path().join(name));
        let text = Rig::BUILT_IN_TOML
            .replace("settle_ms", "lut_file = { green = \"green.csv\" }\nsettle_ms")
            .replace("green = 1.9921875, ", "");
        fs::write(&config, text).unwrap();
        fs::write(&table, lut(6.1)).unwrap();
        let rig = Rig::load(&config).unwrap();
        let weights = folder.path().join("w.safetensors");
        fs::copy(concat!(env!("CARGO_MANIFEST_DIR"), "/../model/weights/fast.safetensors"), &weights).unwrap();
        let loaded = Weights::load(&weights).unwrap();
        let xxh3 = |path| SourceFile::of(path, String::new()).unwrap().xxh3;
        let expected = [xxh3(&weights), xxh3(&table)];
        fs::write(&weights, "another file").unwrap();
        fs::write(&table, lut(6.2)).unwrap();
        let said = MadeWith::of(&rig, &loaded);
        let table_xxh3 = &said.rig_tables_xxh3["panel.lut_file.green"];
        assert_eq!([said.weights_xxh3.as_ref().unwrap(), table_xxh3], [&expected[0], &expected[1]]);
        assert_eq!(said.rig_tables_xxh3.len(), 1);

        let changed = MadeWith::of(&Rig::load(&config).unwrap(), &Weights::builtin_fast());
        assert_eq!((&changed.rig_hash, &changed.weights_xxh3), (&said.rig_hash, &None));
        assert_eq!(changed.rig_tables_xxh3["panel.lut_file.green"], xxh3(&table));
        assert!(MadeWith::of(&Rig::default(), &loaded).rig_tables_xxh3.is_empty());
    }
}
