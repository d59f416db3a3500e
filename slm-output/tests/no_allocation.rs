//! What runs for every frame takes no memory.

use holod_calibration::rig::{PanelMode, Rig};
use holod_calibration::{PerColour, Resolution, TimeNs};
use holod_laser_firmware::{Controller, Hardware, Laser, Limits, Line, TimeUs};
use holod_slm_output::fields::FrameTag;
use holod_slm_output::laser::{DarkReason, LaserBox, SimulatedLaser};
use holod_slm_output::output::pacing_config;
use holod_slm_output::pacing::Pacer;
use holod_slm_output::present::{HeadlessPanel, PanelSetup, Presenter, Recorder, ReportFaults, frame_channel};
use holod_slm_output::schedule::{Evidence, FieldDecision, FieldScheduler, WindowClock};
use holod_slm_output::{FrameLayout, LevelsFrame, PanelEncoder};
use holod_tests::counting::{self, Counting};

#[global_allocator]
static COUNTING: Counting = Counting;

fn taken(work: impl FnOnce()) -> u64 {
    let before = counting::here();
    work();
    counting::here() - before
}

#[test]
fn canary_the_counter_sees_an_allocation() {
    assert_eq!(taken(|| drop(std::hint::black_box(Box::new(1)))), 1);
}

/// A board of fixed memory, whose line a test writes and reads.
struct Board {
    now_us: u64,
    t_edge_us: u64,
    to_box: &'static [u8],
    sent: usize,
    gates: usize,
}

impl Hardware for Board {
    fn now(&mut self) -> TimeUs {
        self.now_us += 10;
        TimeUs(self.now_us)
    }
    fn sync_edge(&mut self) -> Option<TimeUs> {
        let t_edge = TimeUs(self.t_edge_us);
        (self.now_us >= self.t_edge_us).then(|| {
            self.t_edge_us += 1000;
            t_edge
        })
    }
    fn interlock_closed(&mut self) -> bool {
        true
    }
    fn host_present(&mut self) -> bool {
        true
    }
    fn receive(&mut self, bytes: &mut [u8]) -> usize {
        let (now, later) = self.to_box.split_at(self.to_box.len().min(bytes.len()));
        bytes[..now.len()].copy_from_slice(now);
        self.to_box = later;
        now.len()
    }
    fn send(&mut self, line: &[u8]) {
        self.sent += line.len();
    }
    fn set_gate(&mut self, _lit: Option<Laser>) {
        self.gates += 1;
    }
    fn set_power(&mut self, _power_uw: [u32; 3]) {}
    fn feed_watchdog(&mut self) {}
}

#[test]
fn the_laser_boxs_firmware_takes_no_memory() {
    const LIMITS: Limits =
        Limits { power_uw: [1000; 3], timeout_us: 1_000_000, lit_us: 10_000, jitter_us: 10, sync_input: true };
    let program = ["SEQ RGB 1000 SYNC", "FLD 0 100 90", "FLD 1 400 90", "FLD 2 700 90", "MAX 9 9 9", "POW 1 2 3"];
    let rest = ["TMO 500000", "ARM LIGHT", "STAT?", "LIM?", "ID?", "NOW?", "LIT G 1 2", "FRM 1 2"];
    let heartbeats = ["HB"; 200];
    let lines = program.into_iter().chain(rest).chain(heartbeats);
    let bytes: Vec<u8> = lines
        .zip(1..)
        .flat_map(|(line, number)| Line::new(format_args!("{number} {line}")).unwrap().as_bytes().to_vec())
        .collect();
    let mut events = 0;
    let board = Board { now_us: 0, t_edge_us: 1000, to_box: bytes.leak(), sent: 0, gates: 0 };
    let memory = taken(|| {
        let mut controller = Controller::new(board, "bench", LIMITS);
        for _ in 0..20_000 {
            controller.step(&mut |_| events += 1);
        }
        let board = controller.hardware_mut();
        assert!(board.sent > 1000 && board.gates > 1000 && board.to_box.is_empty(), "{} {}", board.sent, board.gates);
    });
    assert_eq!(memory, 0);
    assert!(events > 1000, "{events}");
}

#[test]
fn a_frame_from_phase_to_light_takes_no_memory() {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    for mode in [PanelMode::ChannelPacked, PanelMode::FieldSequential] {
        let mut rig = Rig::default();
        rig.panel.mode = mode;
        let size = Resolution { width: 64, height: 32 };
        let pattern = Resolution { width: 50, height: 20 };
        let encoder = PanelEncoder::new(&rig.panel, size, pattern).unwrap();
        let mut flat = LevelsFrame::new(FrameLayout::new(&rig.panel, size));
        encoder.encode_flat(&mut flat);
        let (mut sink, mut source) = frame_channel(&flat);
        let layout = flat.layout();
        let setup = PanelSetup { panel: rig.panel.clone(), flat: flat.clone() };
        let panel = HeadlessPanel::new(&setup, TimeNs(0), ReportFaults::NONE);
        let mut panel = Recorder::new(Box::new(panel), &flat, 2);
        let stall_timeout = TimeNs(1_000_000_000);
        let mut scheduler =
            FieldScheduler::new(&rig.panel, layout, &rig.lasers, Evidence::Seen, WindowClock::Reports, stall_timeout)
                .unwrap();
        let program = scheduler.program(&rig.panel, &rig.lasers).unwrap();
        let mut laser = SimulatedLaser::new(TimeNs(0));
        laser.program(&program, TimeNs(0)).unwrap();
        let mut pacer = Pacer::new(pacing_config(&rig, TimeNs(1_000_000)).unwrap(), TimeNs(0));
        let phases = vec![1.0; pattern.pixels()];
        let (mut now, mut lit) = (TimeNs(0), 0);
        let mut run = || {
            for frame in 0..300 {
                let plan = pacer.predict(now);
                encoder.encode(PerColour([&phases; 3]), sink.acquire());
                let keep = Some(frame % 2);
                sink.submit(FrameTag {
                    frame_id: plan.frame_id,
                    t_submit: now,
                    t_desired_present: plan.t_desired_present,
                    keep,
                });
                pacer.submitted(plan.frame_id, now);
                for _ in 0..3 {
                    now = panel.t_next().min(scheduler.t_next().unwrap_or(TimeNs(i64::MAX)));
                    panel
                        .tick(now, &mut source, &mut |refresh| {
                            scheduler.on_refresh(&refresh);
                            if let Some(frame) = refresh.frame {
                                pacer.report(frame.frame_id, refresh.t_present, refresh.timestamp_source);
                            }
                        })
                        .unwrap();
                    while let Some(FieldDecision { orders, .. }) = scheduler.next_field(now) {
                        if orders.arm {
                            laser.arm(now).unwrap();
                        }
                        if orders.heartbeat {
                            laser.heartbeat(now).unwrap();
                        }
                        if let Some(t_sync) = orders.sync {
                            laser.sync(t_sync, now).unwrap();
                        }
                        if let Some(window) = orders.light {
                            laser.light(window, now).unwrap();
                        }
                    }
                    laser.poll(now, &mut |_| lit += 1).unwrap();
                }
            }
            laser.set_dark(DarkReason::Shutdown, now);
        };
        // The levels are written by a pool's thread, as by a renderer's.
        let memory = pool.install(|| taken(&mut run));
        assert_eq!(memory, 0);
        assert!(lit > 1000, "{lit}");
    }
}
