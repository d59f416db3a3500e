//! `holod report`: packs what somebody else needs to see what happened here.

use std::path::{Path, PathBuf};

use crate::bug_report::{Contents, Scrubber, default_name};
use crate::cli::ReportArgs;
use crate::destination::Destination;
use crate::failure::Failure;
use crate::machine::Machine;
use crate::staging::Staging;
use crate::{logging, progress, results, status};

pub(super) fn report(args: &ReportArgs) -> Result<(), Failure> {
    let scrubber = Scrubber::of_this_machine();
    let contents = match &args.record {
        Some(folder) => progress::during("looking through the record", || {
            Contents::of_record(folder, !args.without_scene, &scrubber)
        })?,
        None => {
            let running =
                status::of_running().map(|found| found.into_iter().filter_map(|found| found.status).collect());
            Contents::of_running(running, &scrubber)?
        }
    };
    let path = args.out.clone().unwrap_or_else(|| default_name(&contents));
    let destination = Destination::new(&path, "--out", args.force)?;
    destination.refuse_json("--out", args.json)?;
    destination.refuse_inputs("--out", args.record.iter().flat_map(|record| contents_of(record)))?;
    let mut manifest = None;
    destination.write(|path| {
        let staging = Staging::of_file(path, args.force)?;
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let packed = progress::during("packing", || contents.write(&staging.path(&name), &scrubber))?;
        staging.commit()?;
        manifest = Some(packed);
        Ok(())
    })?;
    let Some(manifest) = manifest else { return Ok(()) };
    if destination.is_stdout() {
        logging::say(&manifest.text());
        return Ok(());
    }
    if args.json {
        return results::print_json(&manifest);
    }
    let bytes = path.metadata().map_or(0, |metadata| metadata.len());
    results::print(&format!(
        "{}\nholod     {}\n{}\n\n{} is written ({bytes} bytes); `tar tzf` lists it. Look into it before you send it.",
        manifest.text(),
        manifest.holod,
        Machine::text(&manifest.machine),
        path.display(),
    ))
}

/// The files of a record, those of its bench among them.
fn contents_of(record: &Path) -> Vec<PathBuf> {
    let files = |folder: &Path| std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
    files(record).chain(files(&record.join("bench"))).collect()
}
