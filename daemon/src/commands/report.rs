//! `holod report`: packs what somebody else needs to see what happened here.

use std::path::Path;

use crate::bug_report::{Contents, Scrubber, default_name};
use crate::cli::ReportArgs;
use crate::destination::Destination;
use crate::failure::{Exit, Failure};
use crate::machine::Machine;
use crate::snapshot::Snapshot;
use crate::staging::Staging;
use crate::{progress, report, status};

pub(super) fn report(args: &ReportArgs) -> Result<(), Failure> {
    let scrubber = Scrubber::of_this_machine();
    let contents = match &args.record {
        Some(folder) => progress::during("looking through the record", || {
            Contents::of_record(folder, !args.without_scene, &scrubber)
        })?,
        None => {
            let running: Vec<Snapshot> =
                status::of_running().unwrap_or_default().into_iter().map(|found| found.status).collect();
            Contents::of_running(&running, &scrubber)?
        }
    };
    let path = args.out.clone().unwrap_or_else(|| default_name(&contents));
    let destination = Destination::new(&path, "--out", args.force)?;
    let mut manifest = None;
    destination.write(|path| {
        let name = path.file_name().and_then(|name| name.to_str()).ok_or_else(|| {
            Failure::new(Exit::CannotCreate, format!("--out {}: expected the name of a file to write", path.display()))
        })?;
        let staging = Staging::new(path.parent().unwrap_or(Path::new("")), &[name], args.force)?;
        let packed = progress::during("packing", || contents.write(&staging.path(name), &scrubber))?;
        staging.commit()?;
        manifest = Some(packed);
        Ok(())
    })?;
    let Some(manifest) = manifest else { return Ok(()) };
    if destination.is_stdout() {
        eprintln!("{}", manifest.text());
        return Ok(());
    }
    if args.json {
        return report::print_json(&manifest);
    }
    let bytes = path.metadata().map_or(0, |metadata| metadata.len());
    report::print(&format!(
        "{}\nholod     {}\n{}\n\n{} is written ({bytes} bytes); `tar tzf` lists it. Look into it before you send it.",
        manifest.text(),
        manifest.holod,
        Machine::text(&manifest.machine),
        path.display(),
    ))
}
