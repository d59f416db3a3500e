//! What runs for every frame takes no memory. Only a global allocator sees that, and one cannot be written without
//! `unsafe`.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use holod_calibration::rig::{PanelMode, Rig};
use holod_calibration::{PerColour, Resolution, TimeNs};
use holod_slm_output::fields::FrameTag;
use holod_slm_output::laser::gate::Gate;
use holod_slm_output::laser::interlock::Interlock;
use holod_slm_output::laser::{DarkReason, LaserBox, SimulatedLaser};
use holod_slm_output::output::pacing_config;
use holod_slm_output::pacing::{Pacer, Point};
use holod_slm_output::present::{HeadlessPanel, PanelTiming, Presenter, frame_channel};
use holod_slm_output::{FrameLayout, LevelsFrame, PanelEncoder};

struct Counting;

thread_local! {
    static TAKEN: Cell<u64> = const { Cell::new(0) };
}

// SAFETY: every call is handed to the system's allocator as it is.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        TAKEN.set(TAKEN.get() + 1);
        // SAFETY: the caller's promises are the ones asked for here.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        // SAFETY: as above.
        unsafe { System.dealloc(memory, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

fn taken(work: impl FnOnce()) -> u64 {
    let before = TAKEN.get();
    work();
    TAKEN.get() - before
}

#[test]
fn canary_the_counter_sees_an_allocation() {
    assert_eq!(taken(|| drop(std::hint::black_box(Box::new(1)))), 1);
}

#[test]
fn a_frame_from_phase_to_light_takes_no_memory() {
    for mode in [PanelMode::ChannelPacked, PanelMode::FieldSequential] {
        let mut rig = Rig::default();
        rig.panel.mode = mode;
        let size = Resolution { width: 64, height: 32 };
        let pattern = Resolution { width: 50, height: 20 };
        let encoder = PanelEncoder::new(&rig.panel, size, pattern).unwrap();
        let mut flat = LevelsFrame::new(FrameLayout::new(&rig.panel, size));
        encoder.encode_flat(&mut flat);
        let (mut sink, mut source) = frame_channel(&flat);
        let mut panel = HeadlessPanel::new(PanelTiming::new(&rig.panel), flat, TimeNs(0), 2);
        let gate = Gate::new(&rig.panel, &rig.lasers).unwrap();
        let program = gate.program(&rig.panel, &rig.lasers).unwrap();
        let mut interlock = Interlock::new(gate, program.trigger, program.sequence, true, TimeNs(1_000_000_000));
        let mut laser = SimulatedLaser::new(TimeNs(0));
        laser.set_program(&program, TimeNs(0)).unwrap();
        let mut pacer = Pacer::new(pacing_config(&rig, TimeNs(1_000_000)).unwrap(), TimeNs(0));
        let phases = vec![1.0; pattern.pixels()];
        let (mut now, mut lit) = (TimeNs(0), 0);
        let memory = taken(|| {
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
                pacer.mark(Point::Submit, plan.frame_id, now);
                for _ in 0..3 {
                    now = panel.t_next();
                    panel.tick(now, &mut source, &mut |field| {
                        let (orders, _) = interlock.on_field(&field, now);
                        if orders.arm {
                            laser.set_armed(now).unwrap();
                        }
                        if orders.heartbeat {
                            laser.hear_heartbeat(now).unwrap();
                        }
                        if let Some(t_sync) = orders.sync {
                            laser.see_sync(t_sync, now).unwrap();
                        }
                        if let Some(window) = orders.light {
                            laser.take_window(window, now).unwrap();
                        }
                        if let Some(frame) = field.frame {
                            pacer.report(frame.frame_id, field.t_present, field.provenance);
                        }
                    });
                    laser.poll(now, &mut |_| lit += 1).unwrap();
                }
            }
            laser.set_dark(DarkReason::Shutdown, now);
        });
        assert_eq!(memory, 0);
        assert!(lit > 1000, "{lit}");
    }
}
