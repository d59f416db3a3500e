//! What holograms are made with, as reports say it.

use std::collections::BTreeMap;
use std::fs::File;

use holod_calibration::Colour;
use holod_calibration::rig::Rig;
use serde::Serialize;

use crate::failure::{Exit, Failure};
use crate::record::{content_xxh3, weights_file};
use crate::setup;

/// The rig and its weights.
#[derive(Serialize)]
pub struct MadeWith {
    /// The network's weights by name, or their file's name.
    pub weights: String,
    /// XXH3 of 64 bits of the weights' file, hexadecimal; none of built-in ones.
    pub weights_xxh3: Option<String>,
    /// The rig's name.
    pub rig: String,
    /// Of the rig file's text, as `holod check` states it; none of the built-in rig.
    pub rig_hash: Option<String>,
    /// XXH3 of 64 bits, hexadecimal, of each measured table that the rig file names, by its key there: the panel's
    /// look-up tables and pictures of flatness.
    pub rig_tables_xxh3: BTreeMap<String, String>,
}

impl MadeWith {
    /// What `rig` makes holograms with.
    ///
    /// # Errors
    /// A file cannot be read.
    pub fn of(rig: &Rig) -> Result<Self, Failure> {
        Ok(Self {
            weights: setup::weights_name(&rig.model.weights),
            weights_xxh3: weights_file(&rig.model.weights)?.map(|file| file.xxh3),
            rig: rig.name.clone(),
            rig_hash: rig.provenance.hash_text(),
            rig_tables_xxh3: tables_xxh3(rig)?,
        })
    }
}

fn tables_xxh3(rig: &Rig) -> Result<BTreeMap<String, String>, Failure> {
    let mut tables = BTreeMap::new();
    for (key, files) in [("lut_file", &rig.provenance.lut_files), ("flatness_file", &rig.provenance.flatness_files)] {
        for colour in Colour::ALL {
            let Some(path) = &files[colour] else { continue };
            let (_, xxh3) = File::open(path).and_then(|mut file| content_xxh3(&mut file)).map_err(|error| {
                Failure::new(Exit::NoInput, format!("panel.{key}.{colour}: cannot read {}: {error}", path.display()))
            })?;
            tables.insert(format!("panel.{key}.{colour}"), xxh3);
        }
    }
    Ok(tables)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn a_table_that_changes_changes_what_is_said_of_it() {
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
        let said = MadeWith::of(&rig).unwrap();
        assert_eq!(said.rig_tables_xxh3.keys().collect::<Vec<_>>(), ["panel.lut_file.green"]);
        assert_eq!(MadeWith::of(&rig).unwrap().rig_tables_xxh3, said.rig_tables_xxh3);
        fs::write(&table, lut(6.2)).unwrap();
        let changed = MadeWith::of(&rig).unwrap();
        assert_eq!(changed.rig_hash, said.rig_hash);
        assert_ne!(changed.rig_tables_xxh3, said.rig_tables_xxh3);
        fs::remove_file(&table).unwrap();
        let failure = MadeWith::of(&rig).map(|_| ()).unwrap_err();
        assert!(failure.to_string().contains("panel.lut_file.green: cannot read"), "{failure}");
        assert!(MadeWith::of(&Rig::default()).unwrap().rig_tables_xxh3.is_empty());
    }
}
