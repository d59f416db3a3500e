//! The feed with clients in this process: what they hand over, what they do wrong, and a load.

use std::thread;
use std::time::{Duration, Instant};

use holod_model::scene::LiveColour;
use holod_tests::feed::{Answer, FeedClient, hello};

use super::super::{OpenPictures, PictureSource, Pictures, open};
use super::*;

const SIZE: Resolution = Resolution { width: 16, height: 8 };
const PIXELS: usize = SIZE.pixels();
const BENCH: DisplayGeometry = DisplayGeometry::DEFAULT;
const TAKEN: u32 = 0;
const OVERTAKEN: u32 = 1;
const REFUSED: u32 = 2;
const NOT_SHOWN: u32 = 3;

struct Bench {
    _folder: tempfile::TempDir,
    socket: PathBuf,
    feed: Feed,
    sink: Arc<Mutex<PictureSink>>,
    pictures: PictureSource,
}

impl Bench {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let socket = folder.path().join("feed");
        let plan = Arc::new(FeedPlan::new(socket.clone(), SIZE, Fit::Native));
        let OpenPictures { sink, source, feed } = open(&Pictures::Feed(plan), &BENCH, TimeNs(0)).unwrap();
        Self { _folder: folder, socket, feed: feed.unwrap(), sink, pictures: source }
    }

    /// A client that has been told where to write.
    fn client(&self, name: &str) -> FeedClient {
        let mut client = FeedClient::connect(&self.socket).unwrap();
        client.say(&hello(SIZE.width as u32, SIZE.height as u32, None, name)).unwrap();
        assert_eq!(client.answer(), Answer::Ring);
        client
    }

    fn shown(&mut self) -> (RgbdFrame, PictureTag) {
        let (frame, tag) = self.pictures.at(TimeNs(0));
        (RgbdFrame::clone(frame), tag)
    }

    /// What is shown once that is picture `number`: it is made after its client has heard that it was taken.
    fn shown_next(&mut self, number: u64) -> (RgbdFrame, PictureTag) {
        let began = Instant::now();
        while self.shown().1.number != number {
            assert!(began.elapsed() < Duration::from_secs(10), "{number}: {:?}", self.shown().1);
            thread::sleep(Duration::from_millis(1));
        }
        self.shown()
    }

    fn status(&self) -> FeedStatus {
        self.feed.status(host_now())
    }

    fn until(&self, what: &str, mut done: impl FnMut(&FeedStatus) -> bool) {
        let began = Instant::now();
        while !done(&self.status()) {
            assert!(began.elapsed() < Duration::from_secs(10), "{what}: {:?}", self.status());
            thread::sleep(Duration::from_millis(2));
        }
    }
}

/// A picture of one colour at one depth.
fn picture(grey: u8, depth_mm: u16) -> (Vec<u8>, Vec<u8>) {
    (vec![grey; LiveColour::Rgba8.pixel_bytes() * PIXELS], depth_mm.to_ne_bytes().repeat(PIXELS))
}

fn send(client: &mut FeedClient, slot: u32, sequence: u64, grey: u8) -> (u32, String) {
    let (colour, depth) = picture(grey, 1000);
    client.write(slot, &colour, &depth);
    client.hand_over(slot, sequence, 0).unwrap();
    match client.answer() {
        Answer::Free { slot: freed, sequence: of, outcome, text } => {
            assert_eq!((freed, of), (slot, sequence));
            (outcome, text)
        }
        other => panic!("{other:?}"),
    }
}

/// Whether every pixel is of one picture.
fn is_whole(frame: &RgbdFrame) -> bool {
    let one = |values: &[f32]| values.iter().all(|value| *value == values[0]);
    one(&frame.amplitude) && one(&frame.depth_normalised)
}

#[test]
fn what_is_handed_over_is_shown_until_something_newer_is() {
    let mut bench = Bench::new();
    assert_eq!(bench.shown(), (RgbdFrame::black(SIZE), PictureTag::default()));
    let mut client = bench.client("camera");
    let t_before = host_now();
    assert_eq!(send(&mut client, 1, 7, 255), (TAKEN, String::new()));
    let (frame, tag) = bench.shown_next(7);
    assert_eq!(frame.amplitude, [1.0; 3 * PIXELS]);
    assert!((frame.depth_normalised[0] - BENCH.normalised_depth(holod_calibration::Dioptres(1.0)) as f32).abs() < 1e-6);
    assert_eq!(tag.number, 7);
    assert!((t_before..=host_now()).contains(&tag.t_taken.unwrap()), "when it came, where the client does not say");
    bench.until("the status", |status| status.taken == 1);
    let status = bench.status();
    assert_eq!((status.clients, status.shown), (vec!["camera".to_owned()], Some("camera".to_owned())));
    assert!(status.newest_age_s.unwrap() < 10.0);
    drop(client);
    bench.until("the client is gone", |status| status.clients.is_empty());
    assert_eq!((bench.shown().1.number, bench.status().shown), (7, None), "the last picture stays");
}

#[test]
fn pictures_that_wait_are_overtaken_and_slots_come_back() {
    let mut bench = Bench::new();
    let mut client = bench.client("hasty");
    for sequence in 0..300 {
        let slot = (sequence % 3) as u32;
        let (colour, depth) = picture(sequence as u8, 1000);
        if sequence >= 3 {
            let Answer::Free { outcome, .. } = client.answer() else { panic!() };
            assert!([TAKEN, OVERTAKEN].contains(&outcome), "{outcome}");
        }
        client.write(slot, &colour, &depth);
        client.hand_over(slot, 2 * sequence, 0).unwrap();
    }
    bench.until("all are done with", |status| status.taken + status.overtaken == 300);
    assert_eq!((bench.shown_next(598).1.number, bench.status().left_out), (598, 299), "the newest is shown");
}

#[test]
fn no_picture_is_torn_while_two_clients_send_as_fast_as_they_can() {
    let mut bench = Bench::new();
    let stop = Arc::new(std::sync::atomic::AtomicBool::new(false));
    let clients = ["one", "other"].map(|name| {
        let (mut client, stop) = (bench.client(name), Arc::clone(&stop));
        thread::spawn(move || {
            let mut own = vec![0, 1, 2];
            for sequence in 1.. {
                if stop.load(std::sync::atomic::Ordering::Relaxed) {
                    return;
                }
                while own.is_empty() {
                    if let Some(Answer::Free { slot, .. }) = client.answer_within(Duration::from_secs(10)) {
                        own.push(slot);
                    }
                }
                let slot = own.remove(0);
                let (colour, depth) = picture(sequence as u8, 400 + sequence as u16 % 5000);
                client.write(slot, &colour, &depth);
                client.hand_over(slot, sequence, 0).unwrap();
            }
        })
    });
    let (mut looks, mut changes, mut newest) = (0, 0, 0);
    while looks < 20_000 || changes < 200 {
        let (frame, tag) = bench.pictures.at(TimeNs(0));
        assert!(is_whole(frame), "a torn picture");
        assert!(tag.number >= newest, "{} after {newest}", tag.number);
        changes += usize::from(tag.number > newest);
        newest = tag.number;
        looks += 1;
    }
    bench.until("the other one is not shown", |status| status.not_shown > 0);
    stop.store(true, std::sync::atomic::Ordering::Relaxed);
    for client in clients {
        client.join().unwrap();
    }
    let status = bench.status();
    assert_eq!((status.refused, status.connections_refused), (0, 0));
}

#[test]
fn one_pixel_of_another_picture_is_a_tear() {
    let mut frame = RgbdFrame::black(SIZE);
    assert!(is_whole(&frame));
    frame.amplitude[77] = 0.5;
    assert!(!is_whole(&frame));
}

#[test]
fn pictures_that_cannot_be_shown_are_refused_in_words_and_the_last_good_one_stays() {
    let mut bench = Bench::new();
    let mut client = bench.client("faulty");
    assert_eq!(send(&mut client, 0, 5, 255).0, TAKEN);
    let (outcome, text) = send(&mut client, 0, 5, 9);
    assert_eq!((outcome, text.as_str()), (REFUSED, "sequence 5 was found after 5, expected it to rise"));
    let (colour, _) = picture(9, 1000);
    client.write(0, &colour, &[0; 2 * PIXELS]);
    client.hand_over(0, 6, 0).unwrap();
    let Answer::Free { outcome, text, .. } = client.answer() else { panic!() };
    assert_eq!((outcome, text.as_str()), (REFUSED, "found no pixel with a valid depth, expected millimetres above 0"));
    let (colour, depth) = picture(9, 1000);
    client.write(0, &colour, &depth);
    client.hand_over(0, 7, 1_790_000_000_000_000_000).unwrap();
    let Answer::Free { outcome, text, .. } = client.answer() else { panic!() };
    assert_eq!(outcome, REFUSED);
    assert!(text.contains("expected nanoseconds of CLOCK_MONOTONIC"), "{text}");
    // A game engine's predicted display time, and a difference of clocks that came out below 0.
    for (sequence, t_taken_ns, said) in
        [(8, host_now().0 + 600_000_000, "(not when it is to be shown)"), (9, -1, "taken at -1 ns was found")]
    {
        client.hand_over(0, sequence, t_taken_ns).unwrap();
        let Answer::Free { outcome, text, .. } = client.answer() else { panic!() };
        assert!(outcome == REFUSED && text.contains(said), "{text}");
    }
    assert_eq!((bench.shown().0.amplitude[0], bench.shown().1.number), (1.0, 5));
    bench.until("five are counted", |status| status.refused == 5);
    assert_eq!(send(&mut client, 0, 10, 0).0, TAKEN, "it may go on");
}

#[test]
fn a_client_that_breaks_the_rules_is_told_and_shown_out() {
    let bench = Bench::new();
    let told = |say: &dyn Fn(&mut FeedClient), expected: &str| {
        let mut client = FeedClient::connect(&bench.socket).unwrap();
        say(&mut client);
        let answer = std::iter::repeat_with(|| client.answer()).find(|answer| *answer != Answer::Ring);
        let Some(Answer::Nope(text)) = answer else { panic!("{answer:?}") };
        assert!(text.contains(expected), "{text}");
        assert_eq!(client.answer(), Answer::Closed);
    };
    let good = hello(SIZE.width as u32, SIZE.height as u32, None, "x");
    told(&|client| client.say(b"GET / HTTP/1.1\r\n").unwrap(), "expected HELO or FRAM");
    told(&|client| client.hand_over(0, 1, 0).unwrap(), "FRAM: was found first, expected HELO");
    told(&|client| client.say(&[0; 4000]).unwrap(), "expected HELO or FRAM");
    told(
        &|client| client.say(&hello(17, 8, None, "x")).unwrap(),
        "found pictures of 17x8, larger than the hologram of 16x8",
    );
    let twice = |client: &mut FeedClient| {
        client.say(&good).unwrap();
        client.say(&good).unwrap();
    };
    told(&twice, "HELO: a second one was found");
    let foreign = |client: &mut FeedClient| {
        client.say(&good).unwrap();
        client.hand_over(3, 1, 0).unwrap();
    };
    told(&foreign, "slot 3 was found, expected 0 to 2");
    bench.until("all are counted", |status| status.connections_refused == 6 && status.clients.is_empty());
    let by = |reason: &str| bench.status().connections_refused_by[reason];
    assert_eq!(["protocol", "pictures", "full", "deaf", "socket"].map(by), [5, 1, 0, 0, 0]);
    assert!(bench.status().last_refusal.is_some());
}

#[test]
fn the_ninth_client_is_refused_and_takes_a_place_that_is_given_up() {
    let bench = Bench::new();
    let clients: Vec<_> = (0..CLIENTS).map(|number| bench.client(&number.to_string())).collect();
    let mut late = FeedClient::connect(&bench.socket).unwrap();
    assert_eq!(late.answer(), Answer::Nope("8 clients are connected already; end one of them".into()));
    bench.until("it is counted", |status| status.connections_refused_by["full"] == 1);
    drop(clients);
    bench.until("they are gone", |status| status.clients.is_empty());
    bench.client("late");
}

#[test]
fn connections_that_say_nothing_keep_nobody_out() {
    let bench = Bench::new();
    let mut silent: Vec<_> = (0..CLIENTS).map(|_| FeedClient::connect(&bench.socket).unwrap()).collect();
    let refused = |status: &FeedStatus| status.connections_refused_by.get("protocol") == Some(&(CLIENTS as u64));
    bench.until("they are shown out", refused);
    assert_eq!(silent[0].answer(), Answer::Nope("nothing was found for 5 s, expected HELO".into()));
    bench.client("late");
}

#[test]
fn another_client_is_shown_once_the_first_is_gone_or_silent() {
    let mut bench = Bench::new();
    let (mut first, mut second) = (bench.client("first"), bench.client("second"));
    assert_eq!(send(&mut first, 0, 1, 255).0, TAKEN);
    assert_eq!(send(&mut second, 0, 10, 0).0, NOT_SHOWN);
    bench.shown_next(1);
    let began = Instant::now();
    let mut sequence = 10;
    while bench.shown().1.number < 10 {
        sequence += 1;
        send(&mut second, 0, sequence, 0);
        assert!(began.elapsed() < Duration::from_secs(10));
        thread::sleep(Duration::from_millis(50));
    }
    assert!(began.elapsed() > Duration::from_millis(1500), "two seconds of silence");
    assert_eq!(send(&mut first, 0, 2, 255).0, NOT_SHOWN);
    drop(second);
    bench.until("the second is gone", |status| status.clients.len() == 1);
    assert_eq!(send(&mut first, 0, 3, 255).0, TAKEN);
}

#[test]
fn the_time_just_before_a_picture_is_handed_over_is_when_it_was_taken() {
    let mut bench = Bench::new();
    let mut client = bench.client("prompt");
    let (colour, depth) = picture(9, 1000);
    client.write(0, &colour, &depth);
    for sequence in 1..200 {
        let t_taken = host_now();
        client.hand_over(0, sequence, t_taken.0).unwrap();
        let Answer::Free { outcome: TAKEN, .. } = client.answer() else { panic!("picture {sequence}") };
        assert_eq!(bench.shown_next(sequence).1.t_taken, Some(t_taken));
    }
}

#[test]
fn a_client_of_which_nothing_can_be_shown_is_not_shown_and_keeps_nobody_away() {
    let mut bench = Bench::new();
    let (mut covered, mut good) = (bench.client("covered"), bench.client("good"));
    let (colour, _) = picture(9, 1000);
    let mut refused = |sequence: u64| {
        covered.write(0, &colour, &[0; 2 * PIXELS]);
        covered.hand_over(0, sequence, 0).unwrap();
        assert!(matches!(covered.answer(), Answer::Free { outcome: REFUSED | NOT_SHOWN, .. }));
    };
    refused(1);
    bench.until("it is counted", |status| status.refused == 1 && status.shown.is_none());
    assert_eq!(send(&mut good, 0, 1, 255).0, TAKEN);
    bench.until("the good one is shown", |status| status.shown.as_deref() == Some("good"));
    refused(2);
    assert_eq!(send(&mut good, 0, 2, 255).0, TAKEN);
    bench.shown_next(2);
    // As one does whose lens was covered while it was shown.
    drop(good);
    bench.until("the good one is gone", |status| status.clients.len() == 1 && status.shown.is_none());
    refused(3);
    bench.until("it is counted", |status| status.refused >= 2 && status.shown.is_none());
    let mut late = bench.client("late");
    assert_eq!(send(&mut late, 0, 1, 255).0, TAKEN, "at once");
}

#[test]
fn while_a_scene_is_shown_no_client_is() {
    let mut bench = Bench::new();
    let mut client = bench.client("camera");
    assert_eq!(send(&mut client, 0, 1, 255).0, TAKEN);
    bench.shown_next(1);
    let frames = vec![Arc::new(RgbdFrame::black(SIZE))];
    let scene = scene::Frames { frames, fps: None, reports: Vec::new(), name: "scene".into() };
    bench.sink.lock().unwrap().show_scene(Arc::new(scene), TimeNs(0), 1);
    assert_eq!(send(&mut client, 0, 2, 255).0, NOT_SHOWN);
    assert_eq!(bench.shown().0.amplitude[0], 0.0);
    bench.until("it is counted", |status| status.not_shown == 1);
    bench.sink.lock().unwrap().go_live();
    assert_eq!(send(&mut client, 0, 3, 255).0, TAKEN);
    bench.shown_next(3);
}

#[test]
fn a_picture_before_the_end_of_its_client_is_shown() {
    let mut bench = Bench::new();
    for round in 1..50_u64 {
        let client = bench.client("hasty");
        let (colour, depth) = picture(255, 1000);
        // An answer that it has not read makes of its end a reset.
        for slot in 0..2 {
            client.write(slot, &colour, &depth);
            client.hand_over(slot, 2 * round + u64::from(slot), 0).unwrap();
        }
        drop(client);
        let began = Instant::now();
        while bench.shown().1.number != 2 * round + 1 {
            assert!(began.elapsed() < Duration::from_secs(10), "round {round}: {:?}", bench.shown().1);
            thread::sleep(Duration::from_millis(1));
        }
    }
}

#[test]
fn frames_that_others_keep_are_replaced_by_new_ones() {
    let mut bench = Bench::new();
    let mut client = bench.client("camera");
    let kept: Vec<_> = (0..20)
        .map(|sequence| {
            assert_eq!(send(&mut client, 0, sequence, sequence as u8).0, TAKEN);
            bench.shown_next(sequence);
            Arc::clone(bench.pictures.at(TimeNs(0)).0)
        })
        .collect();
    assert!(kept.is_sorted_by(|a, b| a.amplitude[0] < b.amplitude[0]), "none was written to again");
}

#[test]
fn a_slot_that_was_given_back_may_be_written_while_the_frame_is_made() {
    let mut bench = Bench::new();
    let mut client = bench.client("quick");
    let right = {
        assert_eq!(send(&mut client, 0, 1, 200).0, TAKEN);
        bench.shown_next(1).0
    };
    for sequence in 2..200 {
        assert_eq!(send(&mut client, 0, sequence, 200).0, TAKEN);
        let (colour, depth) = picture(10, 3000);
        client.write(0, &colour, &depth);
        assert!(bench.shown_next(sequence).0 == right, "picture {sequence}");
    }
    assert_eq!(send(&mut client, 0, 200, 10).0, TAKEN);
    assert!(bench.shown_next(200).0 != right, "another picture is told from it");
}

#[test]
fn bad_depths_are_counted_in_each_picture_and_in_all() {
    let mut bench = Bench::new();
    let mut client = bench.client("holes");
    let (colour, mut depth) = picture(9, 1000);
    depth[..6].fill(0);
    depth[6..8].copy_from_slice(&1_u16.to_ne_bytes());
    client.write(0, &colour, &depth);
    client.hand_over(0, 1, 0).unwrap();
    bench.shown_next(1);
    let bad = BadDepths { zero: 3, beyond_near: 1, ..BadDepths::default() };
    bench.until("one picture is counted", |status| (status.bad_depths, status.pictures_with_bad_depths) == (bad, 1));
    client.answer();
    assert_eq!(send(&mut client, 0, 2, 9).0, TAKEN);
    bench.until("a good one has none", |status| status.taken == 2 && status.bad_depths == BadDepths::default());
    client.write(0, &colour, &[0; 2 * PIXELS]);
    client.hand_over(0, 3, 0).unwrap();
    bench.until("those of a refused one count, too", |status| status.refused == 1);
    let status = bench.status();
    assert_eq!(status.bad_depths_in_all, BadDepths { zero: 3 + PIXELS as u64, beyond_near: 1, ..BadDepths::default() });
    assert_eq!(status.pictures_with_bad_depths, 2);
}

#[test]
fn clipped_colours_are_counted_in_every_picture() {
    // Half floats: 0.5, 1, 2 and -1.
    let [half, white, twice_white, below_black] = [0x3800_u16, 0x3c00, 0x4000, 0xbc00];
    let mut bench = Bench::new();
    let mut client = FeedClient::connect(&bench.socket).unwrap();
    let mut hello = hello(SIZE.width as u32, SIZE.height as u32, None, "bright");
    hello[16..20].copy_from_slice(&2_u32.to_ne_bytes());
    client.say(&hello).unwrap();
    assert_eq!(client.answer(), Answer::Ring);
    let (_, depth) = picture(0, 1000);
    let mut show = |sequence: u64, reds: &[u16]| {
        let reds = reds.iter().chain(std::iter::repeat(&half)).take(PIXELS);
        let colour: Vec<u8> = reds.flat_map(|&red| [red, half, white, 0]).flat_map(u16::to_ne_bytes).collect();
        client.write(0, &colour, &depth);
        client.hand_over(0, sequence, 0).unwrap();
        bench.shown_next(sequence);
        client.answer();
    };
    show(1, &[white]);
    show(2, &[twice_white, below_black, twice_white]);
    show(3, &[below_black]);
    bench.until("all are counted", |status| status.taken == 3 && status.pictures_with_clipped_colours == 2);
    let status = bench.status();
    assert_eq!(status.clipped_colours, ClippedPixels { above_white: 0, below_black: 1 });
    assert_eq!(status.clipped_colours_in_all, ClippedPixels { above_white: 2, below_black: 2 });
}

#[test]
fn how_a_picture_was_taken_goes_with_it_in_version_2_alone() {
    let mut bench = Bench::new();
    let mut newer = FeedClient::connect(&bench.socket).unwrap();
    let mut hello = hello(SIZE.width as u32, SIZE.height as u32, None, "camera");
    hello[4..8].copy_from_slice(&2_u32.to_ne_bytes());
    newer.say(&hello).unwrap();
    assert_eq!(newer.answer(), Answer::Ring);
    let (colour, depth) = picture(9, 1000);
    newer.write(0, &colour, &depth);
    newer.write(1, &colour, &depth);
    newer.hand_over_with(0, 1, 0, 3, [1.25, 60.0, 45.0]).unwrap();
    let view = PictureView { focus_dpt: Some(1.25), field_of_view_deg: Some([60.0, 45.0]) };
    assert_eq!(bench.shown_next(1).1.view, view);
    bench.until("the status has it", |status| status.view == view);
    assert_eq!(bench.status().view.text().as_deref(), Some("focused at 1.25 dpt, 60.0 x 45.0 degrees"));
    newer.hand_over(1, 2, 0).unwrap();
    assert_eq!(bench.shown_next(2).1.view, PictureView::default(), "each picture says it of itself");
    let mut older = bench.client("older");
    older.hand_over_with(0, 1, 0, 1, [1.25, 0.0, 0.0]).unwrap();
    assert_eq!(
        older.answer(),
        Answer::Nope("FRAM: reserved bytes that are not 0 were found, expected 0 in version 1".into())
    );
}

#[test]
fn what_is_measured_is_measured_in_each_round() {
    let cost = cost::measure(SIZE, 5).unwrap();
    assert_eq!(cost.picture_bytes, 6 * PIXELS);
    for times in [cost.memcpy, cost.take, cost.make] {
        assert!(times.len() == 5 && times.iter().any(|time| !time.is_zero()), "{times:?}");
    }
}

#[test]
fn shared_memory_cannot_be_made_shorter_under_holod() {
    let bench = Bench::new();
    let client = bench.client("hostile");
    assert!(rustix::fs::ftruncate(client.memory().unwrap(), 0).is_err());
}

#[test]
fn memory_that_a_client_gives_back_is_read_as_zeros() {
    use rustix::fs::{FallocateFlags, fallocate, fstat};

    let mut bench = Bench::new();
    let mut client = bench.client("holes");
    assert_eq!(send(&mut client, 0, 1, 255).0, TAKEN);
    bench.shown_next(1);
    let memory = client.memory().unwrap();
    let punch = FallocateFlags::PUNCH_HOLE | FallocateFlags::KEEP_SIZE;
    fallocate(memory, punch, 0, fstat(memory).unwrap().st_size as u64).unwrap();
    client.hand_over(0, 2, 0).unwrap();
    let Answer::Free { outcome, text, .. } = client.answer() else { panic!() };
    assert_eq!((outcome, text.as_str()), (REFUSED, "found no pixel with a valid depth, expected millimetres above 0"));
    assert_eq!(send(&mut client, 0, 3, 0).0, TAKEN, "and written anew");
    assert_eq!(bench.shown_next(3).0.amplitude[0], 0.0);
}

#[test]
fn a_client_that_never_reads_is_shown_out_and_nobody_waits_for_it() {
    let mut bench = Bench::new();
    let deaf = bench.client("deaf");
    for sequence in 0..10_000 {
        // It knows what is free without having read it.
        if deaf.hand_over((sequence % 3) as u32, sequence, 0).is_err() {
            break;
        }
        bench.until("its picture is done with", |status| {
            status.taken + status.overtaken + status.refused > sequence || status.connections_refused > 0
        });
    }
    bench.until("it is gone", |status| status.connections_refused > 0 && status.clients.is_empty());
    assert_eq!(bench.status().last_refusal.as_deref(), Some("it does not read what holod sends"));
    assert_eq!(bench.status().connections_refused_by["deaf"], 1);
    let mut other = bench.client("other");
    assert_eq!(send(&mut other, 0, 1, 255).0, TAKEN);
    assert_eq!(bench.shown_next(1).0.amplitude[0], 1.0);
}

#[test]
fn the_socket_goes_with_the_feed() {
    let bench = Bench::new();
    let mut client = bench.client("left alone");
    let Bench { feed, socket, _folder, .. } = bench;
    drop(feed);
    assert_eq!(client.answer(), Answer::Closed);
    assert!(!socket.exists());
}
