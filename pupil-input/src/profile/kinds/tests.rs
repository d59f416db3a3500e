use std::fs;

use super::KINDS;
use crate::profile::FILES;
use crate::profile::parse::parse;
use crate::wire::Format;
use crate::wire::delimited::{Column, Separator};
use crate::wire::field::{Field, Literal, NumberType, SizeKind, Validity};
use crate::wire::packet::PacketLength;
use crate::wire::{ChecksumKind, Crc};

const LINES: &str = "format = \"holod-tracker-1\"\nname = \"x\"\n[wire]\nkind = \"delimited\"\n";
const PACKET: &str = "format = \"holod-tracker-1\"\nname = \"x\"\n[wire]\nkind = \"packet\"\n";
const REPORT: &str = "format = \"holod-tracker-1\"\nname = \"x\"\n[wire]\nkind = \"report\"\n";

/// What is wrong with `keys` behind `head`.
fn faults(head: &str, keys: &str) -> String {
    let faults = parse(&format!("{head}{keys}")).err().unwrap_or_default();
    faults.iter().map(|fault| format!("{fault}\n")).collect()
}

#[test]
fn each_mistake_is_told_with_its_line_and_key() {
    let size = "left = { size = 1 }\n";
    let packet = "sync = [1, 2]\nlength = 8\n";
    let pupil = "left = { size = { at = 2, type = \"u16\" } }\n";
    let cases: &[(&str, &str, &str)] = &[
        ("", "format = 1 = 2", "line 1: found `format = 1 = 2`; expected TOML"),
        ("", "name = \"x\"", "format: found nothing; expected \"holod-tracker-1\"; add format to the top of the file"),
        (
            "",
            "format = \"holod-tracker-2\"",
            "line 1, format: found \"holod-tracker-2\"; expected one of \"holod-tracker-1\"",
        ),
        ("", "format = \"holod-tracker-1\"\n[wire]\nkind = \"holod\"", "name: found nothing"),
        ("", "name = \"\"", "line 1, name: found an empty text; expected the profile's name; fill it in\n"),
        ("", "wires = 1", "line 1, wires: found an unknown key"),
        ("", "wires = 1", "did you mean `wire`?"),
        ("", "eye = \"middle\"", "line 1, eye: found \"middle\"; expected one of \"left\", \"right\", \"both\""),
        ("", "rate_hz = 0", "line 1, rate_hz: found 0; expected a number above 0"),
        (
            "",
            "rate_hz = \"60\"",
            "line 1, rate_hz: found a string \"60\"; expected a number above 0; write a plain number",
        ),
        ("", "about = 3", "line 1, about: found an integer 3"),
        ("", "serial = 3", "line 1, serial: found an integer 3; expected a table"),
        ("", "[serial]\nbaud = 0", "line 2, serial.baud: found 0; expected a whole number from 1"),
        (
            "",
            "[serial]\nparity = 0",
            "line 2, serial.parity: found an unknown key; expected one of baud, start, stop, usb",
        ),
        ("", "[serial]\nusb = [\"12\"]", "line 2, serial.usb[0]: found \"12\""),
        ("", "[serial]\nusb = \"1209:0001\"", "line 2, serial.usb: found a string"),
        ("", "[serial]\nstart = [{ expect = \"x\" }]", "line 2, serial.start[0].send: found nothing"),
        ("", "[serial]\nstart = [{ send = 'x\\y' }]", "`\\y` is no escape"),
        ("", "[serial]\nstart = [{ send = 'x\\x4' }]", "lacks its two hexadecimal digits"),
        ("", "[serial]\nstart = [{ send = \"\u{3c0}\" }]", "is no single byte"),
        ("", "[serial]\nstart = [{ send = [256] }]", "serial.start[0].send: found an array [256]; expected bytes"),
        ("", "[serial]\nstart = [{ send = \"x\", within_ms = 0 }]", "serial.start[0].within_ms: found 0"),
        ("", "[serial]\nstart = [{ send = \"x\", expects = \"y\" }]", "did you mean `expect`?"),
        ("", "[hid]\nusage_page = 65536", "line 2, hid.usage_page: found 65536"),
        ("", "[network]\nport = 0", "line 2, network.port: found 0"),
        (
            "",
            "[size]\nunit = \"inch\"",
            "line 2, size.unit: found \"inch\"; expected one of \"mm\", \"pixels\", \"arbitrary\"",
        ),
        ("", "[size]\nkind = \"diametre\"", "did you mean \"diameter\"?"),
        ("", "[size]\nmm_per_unit = -1", "line 2, size.mm_per_unit: found -1"),
        (
            LINES,
            "left = { size = 1 }\n[size]\nmm_per_unit = 0.05",
            "line 7, size.mm_per_unit: found 0.05; expected none where the unit is mm",
        ),
        (LINES, "left = { size = 1 }\n[size]\nunit = \"mm\"\nmm_per_unit = 2", "line 8, size.mm_per_unit: found 2"),
        ("", "name = \"x\"", "wire: found nothing"),
        (
            "",
            "[wire]\nkind = \"packets\"",
            "line 2, wire.kind: found \"packets\"; expected one of \"holod\", \"delimited\"",
        ),
        ("", "[wire]\nkind = \"packets\"", "did you mean \"packet\"?"),
        ("", "[wire]\nkind = \"holod\"\nsync = 1", "line 3, wire.sync: found an unknown key"),
        // Lines.
        (LINES, "", "line 3, wire: found no pupil"),
        (LINES, "left = {}", "line 5, wire.left.size: found nothing"),
        (LINES, "left = { size = 0 }", "line 5, wire.left.size: found 0; expected a whole number from 1 to 128"),
        (LINES, "left = { size = 1.5 }", "line 5, wire.left.size: found 1.5; expected a column"),
        (LINES, "left = { size = {} }", "wire.left.size.column: found nothing"),
        (LINES, "left = { size = 1, shape = 2 }", "wire.left.shape: found an unknown key"),
        (LINES, "left = { size = { column = 1, scala = 2 } }", "did you mean `scale`?"),
        (LINES, "left = { size = 1 }\nright = { size = 1 }", "line 6, wire.right: found the size of another pupil"),
        (LINES, "pupil = { size = 1 }", "line 5, wire.pupil: found no word on its eye"),
        (LINES, "pupil = { size = 1 }\neye = { column = 2 }", "line 6, wire.eye: found no eye"),
        (LINES, "left = { size = 1, valid = { column = 2 } }", "wire.left.valid: found 0 rules; expected one rule"),
        (LINES, "left = { size = 1, valid = { column = 2, equals = 1, at_least = 2 } }", "found 2 rules"),
        (LINES, "left = { size = 1, valid = { column = 2, all_bits = 0 } }", "valid.all_bits: found 0"),
        (LINES, "left = { size = 1, lost = [true] }", "wire.left.lost[0]: found a boolean true"),
        (LINES, "left = { size = 1, confidence = { column = 2, full = 0 } }", "confidence.full: found 0"),
        (LINES, "left = { size = { column = 1, scale = inf } }", "size.scale: found inf"),
        (LINES, "left = { size = 1 }\ntime = 2", "line 6, wire.time.unit: found nothing"),
        (LINES, "left = { size = 1 }\ntime = { column = 2, unit = \"h\" }", "wire.time.unit: found \"h\""),
        (LINES, "left = { size = 1 }\ntime = { column = 2, unit = \"frames\" }", "found \"frames\" and no rate_hz"),
        (
            "format = \"holod-tracker-1\"\nname = \"x\"\nrate_hz = 60\n[wire]\nkind = \"delimited\"\n",
            "left = { size = 1 }\ntime = { column = 2, unit = \"ms\" }",
            "line 3, rate_hz: found 60; expected none: no time is made from a frame counter; take it out",
        ),
        (
            "format = \"holod-tracker-1\"\nname = \"x\"\nrate_hz = 60\n[wire]\nkind = \"holod\"\n",
            "",
            "line 3, rate_hz: found 60",
        ),
        (
            LINES,
            "left = { size = 1 }\nprefix = \"#P\"",
            "line 6, wire.prefix: found \"#P\"; expected no comment: those begin with `#`",
        ),
        (LINES, "left = { size = 1 }\ntime = { column = 2, unit = \"s\", tick_ns = 5 }", "found unit and tick_ns"),
        (LINES, "left = { size = 1 }\ntime = { column = 2, unit = \"s\", wrap_bits = 63 }", "wrap_bits: found 63"),
        (LINES, "left = { size = 1 }\nseparator = \"ab\"", "line 6, wire.separator: found \"ab\""),
        (LINES, "left = { size = 1 }\nseparator = \".\"", "wire.separator: found \".\""),
        (LINES, "left = { size = 1 }\ndecimal_comma = true", "found a comma in numbers and between columns"),
        (
            LINES,
            "left = { size = 1 }\ndecimal_comma = 1",
            "wire.decimal_comma: found an integer 1; expected true or false",
        ),
        (LINES, "left = { size = 1 }\nprefix = \"a\\n\"", "wire.prefix: found 2 bytes"),
        (LINES, "left = { size = 1 }\ncolumns = [\"a\", \"a\"]", "wire.columns: found"),
        (LINES, "left = { size = \"pupill\" }\ncolumns = [\"pupil\"]", "did you mean `pupil`?"),
        (LINES, "left = { size = 1 }\nchecksum = \"crc\"", "wire.checksum: found \"crc\""),
        (
            LINES,
            "left = { size = 1 }\nchecksum = { kind = \"crc8\", polynomial = 256 }",
            "checksum.polynomial: found 256",
        ),
        (
            LINES,
            "left = { size = 1 }\nchecksum = { kind = \"xor8\", polynomial = 7 }",
            "checksum.polynomial: found an unknown key",
        ),
        (LINES, "left = { size = 1 }\nsync = 1", "line 6, wire.sync: found an unknown key"),
        // Packets.
        (PACKET, "length = 8\n", "line 3, wire.sync: found nothing"),
        (PACKET, "sync = []\nlength = 8\n", "line 5, wire.sync: found 0 bytes"),
        (PACKET, "sync = [1, 2]\n", "wire.length: found nothing"),
        (PACKET, "sync = [1, 2]\nlength = 2\n", "line 6, wire.length: found 2; expected a whole number from 3"),
        (PACKET, "sync = [1, 2]\nlength = { at = 2, type = \"u8\" }\n", "wire.length.least: found nothing"),
        (PACKET, "sync = [1, 2]\nlength = { at = 2, type = \"u8\", least = 9, most = 8 }\n", "found least 9, most 8"),
        (
            PACKET,
            "sync = [1, 2]\nlength = { at = -2, type = \"u8\", least = 8, most = 8 }\n",
            "found a length that is far behind",
        ),
        (
            PACKET,
            "sync = [1, 2]\nlength = 8\nleft = { size = 2 }\n",
            "wire.left.size: found an integer 2; expected a table",
        ),
        (
            PACKET,
            "sync = [1, 2]\nlength = 8\nleft = { size = { type = \"u8\" } }\n",
            "wire.left.size.at: found nothing",
        ),
        (PACKET, "sync = [1, 2]\nlength = 8\nleft = { size = { at = 2 } }\n", "wire.left.size.type: found nothing"),
        (
            PACKET,
            "sync = [1, 2]\nlength = 8\nleft = { size = { at = 2, type = \"u24\" } }\n",
            "size.type: found \"u24\"",
        ),
        (
            PACKET,
            "sync = [1, 2]\nlength = 8\nleft = { size = { at = 7, type = \"u16\" } }\n",
            "line 7, wire.left.size.at: found byte 7; expected all of its 2 bytes within the 8",
        ),
        (
            PACKET,
            "sync = [1, 2]\nlength = 8\nleft = { size = { at = -1, type = \"u16\" } }\n",
            "size.at: found byte -1",
        ),
        (
            PACKET,
            "sync = [1, 2]\nlength = 8\nleft = { size = { at = 1, type = \"u16\" } }\n",
            "found bytes 1 to 2, which wire.sync has",
        ),
        (
            PACKET,
            "sync = [1, 2]\nlength = 8\nleft = { size = { at = 2, type = \"f32\", mask = 1 } }\n",
            "size.mask: found bits of a number with a fraction",
        ),
        (
            PACKET,
            "sync = [1, 2]\nlength = 8\nleft = { size = { at = 2, type = \"u8\", mask = 256 } }\n",
            "size.mask: found 256",
        ),
        (
            PACKET,
            "sync = [1, 2]\nlength = 8\nleft = { size = { at = 2, type = \"u8\", shift = 8 } }\n",
            "size.shift: found 8",
        ),
        (PACKET, "sync = [1, 2]\nlength = 8\nendian = \"middle\"\n", "wire.endian: found \"middle\""),
        (PACKET, "sync = [1, 2]\nlength = 8\nchecksum = { kind = \"sum8\" }\n", "wire.checksum.at: found nothing"),
        (
            PACKET,
            "sync = [1, 2]\nlength = 8\nchecksum = { kind = \"sum8\", at = 8 }\n",
            "wire.checksum.at: found byte 8",
        ),
        (
            PACKET,
            "sync = [1, 2]\nlength = 8\nchecksum = { kind = \"sum8\", at = 7, to = 8 }\n",
            "found bytes 0 to 7 under the checksum at byte 7",
        ),
        (
            PACKET,
            "sync = [1, 2]\nlength = 8\nleft = { size = { at = 2, type = \"u8\" }, lost = \"x\" }\n",
            "wire.left.lost: found \"x\"; expected a number",
        ),
        // Reports.
        (REPORT, "", "line 3, wire: found neither length nor least_length"),
        (REPORT, "length = 8\nleast_length = 8\n", "found length and least_length"),
        (REPORT, "id = 256\nlength = 8\n", "wire.id: found 256"),
        (
            REPORT,
            "id = 1\nlength = 8\nleft = { size = { at = 0, type = \"u8\" } }\n",
            "found bytes 0 to 0, which wire.id has",
        ),
    ];
    for (head, keys, told) in cases {
        let found = faults(head, keys);
        assert!(found.contains(told), "{keys}\n  does not tell {told}\n  but {found}");
    }
    // The canary: what is right has no fault.
    assert_eq!(faults(LINES, size), "");
    assert_eq!(faults(PACKET, &format!("{packet}{pupil}")), "");
    assert_eq!(faults("about = \"\"\n", &format!("{LINES}{size}")), "", "a tracker of which there is nothing to say");
    let eye = "eye = \"left\"
";
    assert!(faults(eye, &format!("{LINES}{size}")).contains("line 1, eye: found left; expected no eye here"));
}

#[test]
fn a_table_that_is_none_is_one_fault_not_one_for_each_of_its_keys() {
    let told = faults(PACKET, "sync = [1, 2]\nlength = 8\nleft = { size = { at = 2, type = \"u8\" } }\nchecksum = 3");
    assert_eq!(told.lines().count(), 1, "{told}");
    assert!(told.starts_with("line 8, wire.checksum: found an integer 3; expected a table"), "{told}");
}

#[test]
fn every_fault_is_told_at_once_in_the_order_of_lines() {
    let text = "format = \"holod-tracker-1\"\nrate_hz = -1\n[serial]\nbaud = 0\n[wire]\nkind = \"delimited\"\n";
    let lines: Vec<_> = parse(text).unwrap_err().into_iter().map(|fault| fault.line).collect();
    assert_eq!(lines, [Some(2), Some(4), Some(5), None]);
}

#[test]
fn every_key_of_a_line_format_is_read() {
    let text = r##"
            format = "holod-tracker-1"
            name = "x"
            about = "y"
            rate_hz = 50
            [size]
            kind = "area"
            unit = "pixels"
            mm_per_unit = 0.5
            [serial]
            baud = 9600
            usb = ["1209:0001", "0403:6001"]
            start = [{ send = "Go\r", expect = '\x06ok', within_ms = 20 }, { send = [0x80] }]
            stop = [{ send = "Stop" }]
            [network]
            port = 4242
            [wire]
            kind = "delimited"
            separator = "whitespace"
            decimal_comma = true
            prefix = "E"
            comment = "//"
            checksum = { kind = "crc16-ccitt", skip = 1, initial = 3, polynomial = 5, final_xor = 7, reflected = true }
            time = { column = 1, unit = "frames", wrap_bits = 16 }
            sequence = { column = "n", wrap_bits = 8 }
            eye = { column = 3, left = ["L", 0], right = "R" }
            [wire.pupil]
            size = { column = "d", scale = 2, offset = -1 }
            lost = [0, "n/a"]
            confidence = { column = 5, full = 100 }
            aperture = { column = 6, scale = 0.1 }
            valid = { column = 7, differs = "bad" }
        "##;
    let profile = parse(text).unwrap_or_else(|faults| panic!("{faults:?}"));
    assert_eq!((profile.name.as_str(), profile.about.as_str(), profile.unit.name()), ("x", "y", "mm"));
    assert_eq!(profile.serial.baud, 9600);
    assert_eq!(profile.serial.usb[1].to_string(), "0403:6001");
    let [first, second] = &profile.serial.start[..] else { panic!("{:?}", profile.serial.start) };
    assert_eq!((&first.send[..], first.expect.as_deref()), (&b"Go\r"[..], Some(&b"\x06ok"[..])));
    assert_eq!((first.within.as_millis(), second.within.as_millis()), (20, 1000));
    assert_eq!((&second.send[..], &profile.serial.stop[0].send[..]), (&[0x80][..], &b"Stop"[..]));
    assert_eq!(profile.network.port, Some(4242));
    let Format::Delimited(settings) = profile.format else { panic!() };
    assert_eq!((settings.separator, settings.decimal_comma), (Separator::Whitespace, true));
    assert_eq!((&settings.prefix[..], &settings.comment[..]), (&b"E"[..], &b"//"[..]));
    let crc = Crc { bits: 16, polynomial: 5, initial: 3, reflected: true, final_xor: 7 };
    assert_eq!(settings.checksum, Some((ChecksumKind::Crc(crc), 1)));
    let layout = settings.layout;
    let time = layout.time.unwrap();
    assert_eq!((time.at, time.ns_per_tick, time.wrap_bits), (Column::Number(1), 2e7, Some(16)));
    assert_eq!(layout.sequence, Some((Column::Name("n".into()), Some(8))));
    let (at, eyes) = layout.eye.unwrap();
    assert_eq!((at, eyes.len(), &eyes[1].0), (Column::Number(3), 3, &Literal::Number(0.0)));
    let pupil = &layout.pupils[0];
    assert_eq!((pupil.eye, pupil.size.scale, pupil.size.offset), (None, 2.0, -1.0));
    assert_eq!(pupil.lost, [Literal::Number(0.0), Literal::Text(b"n/a".to_vec())]);
    assert_eq!(pupil.confidence.as_ref().unwrap().scale, 0.01);
    assert_eq!(pupil.aperture.as_ref().unwrap().scale, 0.1);
    assert_eq!(pupil.valid, Some((Column::Number(7), Validity::Differs(Literal::Text(b"bad".to_vec())))));
    assert_eq!((layout.size.kind, layout.size.mm_per_unit), (SizeKind::Area, 0.5));
}

#[test]
fn every_key_of_a_packet_is_read() {
    let keys = r#"
            sync = "\xFAS"
            endian = "big"
            length = { at = 2, type = "u8", adds = 4, least = 12, most = 40 }
            checksum = { kind = "crc16-modbus", at = -2, from = 2, endian = "little" }
            time = { at = 4, type = "u32", tick_ns = 100, mask = 0xFFFFFF }
            left = { size = { at = 8, type = "i16", shift = 2, endian = "little" }, valid = { at = 3, type = "u8", no_bits = 6 } }
        "#;
    let profile = parse(&format!("{PACKET}{keys}")).unwrap_or_else(|faults| panic!("{faults:?}"));
    let Format::Packet(settings) = profile.format else { panic!() };
    assert_eq!(settings.sync, b"\xFAS");
    let field = |at, kind, big_endian| Field { at, kind, big_endian, shift: 0, mask: None };
    let length = PacketLength::Told { field: field(2, NumberType::U8, true), adds: 4, least: 12, most: 40 };
    assert_eq!(settings.length, length);
    let checksum = settings.checksum.unwrap();
    assert_eq!((checksum.at, checksum.from, checksum.to, checksum.big_endian), (-2, 2, -2, false));
    let time = settings.layout.time.unwrap();
    assert_eq!((time.at.bits(), time.wrap_bits, time.ns_per_tick), (24, Some(24), 100.0));
    let pupil = &settings.layout.pupils[0];
    assert_eq!(pupil.size.at, Field { shift: 2, ..field(8, NumberType::I16, false) });
    assert_eq!(pupil.valid, Some((field(3, NumberType::U8, true), Validity::NoBits(6))));
}

#[test]
fn every_kind_has_a_shipped_profile_and_a_fuzz_target() {
    let targets = fs::read_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/../fuzz/fuzz_targets")).unwrap();
    let targets: Vec<_> = targets.map(|target| target.unwrap().file_name().into_string().unwrap()).collect();
    for kind in &KINDS {
        let key = format!("\nkind = \"{}\"\n", kind.name);
        assert!(FILES.iter().any(|(_, text)| text.contains(&key)), "no profile of {}", kind.name);
        let expected = match kind.name {
            "holod" => vec!["line.rs".into()],
            "core" => vec!["pupil_labs_core.rs".into()],
            "pupilext" => vec!["pupilext_csv.rs".into(), "pupilext_json.rs".into()],
            name => vec![format!("{}.rs", name.replace('-', "_"))],
        };
        assert!(expected.iter().all(|target| targets.contains(target)), "no fuzz target of {}", kind.name);
    }
}
