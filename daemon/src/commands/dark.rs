//! `holod dark`: lasers out, whatever happened before.

use holod_calibration::rig::LaserDriver;
use holod_pupil_input::host_now;
use holod_slm_output::laser::{DarkReason, LaserBox, SerialBox};

use crate::cli::DarkArgs;
use crate::failure::{Exit, Failure};
use crate::{report, setup};

pub(super) fn dark(args: &DarkArgs) -> Result<(), Failure> {
    match setup::rig(&args.rig)?.lasers.driver {
        LaserDriver::Simulated => {
            report::print("no laser box on this bench: its simulated lasers ended with the daemon")
        }
        LaserDriver::Serial { path } => {
            let unavailable = Failure::because(Exit::Unavailable);
            let mut laser = SerialBox::open(&path, host_now).map_err(&unavailable)?;
            laser.dark(DarkReason::Asked, host_now()).map_err(unavailable)?;
            report::print(&format!("{}: the laser box acknowledged that it is dark", path.display()))
        }
    }
}
