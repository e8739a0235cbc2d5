//! Calibration files: what is wrong is said with file, line, field and value.

use xtask::calib::schema::{self, Estimate, Mote};
use xtask::calib::{firmware, quantise, solver};

const GOOD: &str = include_str!("../../calib/default.toml");

fn complaint(text: &str) -> String {
    schema::read("room.toml", text).expect_err("a bad file").to_string()
}

/// The default file with one thing changed.
fn with(from: &str, to: &str) -> String {
    assert!(GOOD.contains(from), "{from}");
    GOOD.replacen(from, to, 1)
}

fn line_of(needle: &str) -> usize {
    1 + GOOD.lines().position(|line| line.contains(needle)).expect("a line of the file")
}

#[test]
fn the_default_room_reads_and_takes_the_fast_form() {
    let calibration = schema::read("room.toml", GOOD).expect("a good file");
    let held = firmware::bake("room.toml", &calibration).expect("a room that can be held");
    assert!(matches!(held.baked.calib, solver::Calib::Fast(_)));
    assert!(held.baked.measured.rms_mm < 0.1 && held.baked.measured.max_mm < 0.6, "{:?}", held.baked.measured);
}

#[test]
fn a_text_where_a_number_belongs_names_line_field_and_value() {
    let line = line_of("phase = 0.046615");
    assert_eq!(
        complaint(&with("phase = 0.046615", "phase = \"much\"")),
        format!("room.toml:{line}: station.A.factory.az.phase: \"much\" is no number")
    );
}

#[test]
fn a_matrix_that_is_no_rotation_is_refused() {
    let said = complaint(&with("0.080301131", "0.8"));
    assert!(said.contains("station.A.rotation: is no rotation"), "{said}");
}

#[test]
fn a_mirror_image_is_refused() {
    let said =
        complaint(&with("[-0.005204195, -0.039386376, -0.999210503]", "[0.005204195, 0.039386376, 0.999210503]"));
    assert!(said.contains("mirror image"), "{said}");
}

#[test]
fn a_key_that_nobody_knows_is_refused() {
    let line = line_of("pan = ");
    assert_eq!(
        complaint(&with("pan = ", "pam = ")),
        format!(
            "room.toml:{line}: mote.pam: unknown; known here: id, pan, estimate, report_every_half_turns, send, moved_m, heartbeat_s, max_angle_age_ms, angle_noise_mrad, factory, lone, shortest_sweep_us, sweep_edge, key_file"
        )
    );
}

#[test]
fn millimetres_are_not_taken_for_metres() {
    let said = complaint(&with("position = [0.259609,", "position = [259.609,"));
    assert!(said.contains("station.A.position: 259.609 m is beyond 100 m"), "{said}");
}

#[test]
fn numbers_that_no_mote_holds_are_refused() {
    for (from, to, says) in [
        ("id = 1", "id = 65535", "mote.id: 65535"),
        ("report_every_half_turns = 8", "report_every_half_turns = 0", "mote.report_every_half_turns: 0"),
        ("max_angle_age_ms = 100", "max_angle_age_ms = nan", "mote.max_angle_age_ms: nan is not finite"),
        ("estimate = \"track\"", "estimate = \"guess\"", "mote.estimate: \"guess\""),
        ("max = [1.54, 1.99, 1.10]", "max = [1.54, 1.99, -2.0]", "room.max: -2 is not above"),
        ("[station.B]", "[station.C]", "station.C: unknown"),
        ("phase = 0.046615", "phase = 4.6615", "phase: 4.6615 rad is beyond"),
    ] {
        let said = complaint(&with(from, to));
        assert!(said.contains(says), "{to}: {said}");
    }
}

#[test]
fn a_file_that_is_no_toml_names_the_line() {
    let said = complaint("[station\n");
    assert!(said.starts_with("room.toml:1: "), "{said}");
}

#[test]
fn a_room_around_a_station_is_refused_with_the_number() {
    let text = with("max = [1.54, 1.99, 1.10]", "max = [1.54, 1.99, 3.0]");
    let calibration = schema::read("room.toml", &text).expect("a file that reads");
    let said = firmware::bake("room.toml", &calibration).expect_err("a station inside").to_string();
    assert_eq!(
        said,
        "room.toml: room: cannot be represented: a station stands inside the volume; its x in metres: 0.259609"
    );
}

/// Two stations 4 m apart that look the same way, and a volume so far ahead of both.
fn far_away(near: f64, far: f64, estimate: &str) -> String {
    let rotation = "rotation = [[-1, 0, 0], [0, 0, 1], [0, 1, 0]]";
    format!(
        "[room]\nmin = [-0.5, {near}, 0.5]\nmax = [0.5, {far}, 1.5]\n[mote]\nestimate = \"{estimate}\"\n\
         [station.A]\n{rotation}\nposition = [-2, 0, 2]\n[station.B]\n{rotation}\nposition = [2, 0, 2]\n"
    )
}

#[test]
fn a_room_in_which_no_track_could_begin_is_refused_with_the_number() {
    let bake = |text: &str| {
        let calibration = schema::read("room.toml", text).expect("a file that reads");
        let held = firmware::bake("room.toml", &calibration).map_err(|error| error.to_string());
        held.map(|held| (held.warning(&calibration.mote), held.baked.out_of_reach))
    };
    let said = bake(&far_away(8.5, 9.5, "track")).expect_err("no track");
    assert!(said.starts_with("room.toml: room: no track could begin in it: its nearest point is 8.50 m"), "{said}");
    let (warning, out) = bake(&far_away(8.5, 9.5, "fix")).expect("fixes do without");
    assert!(warning.is_none() && out.share == 1.0, "{warning:?} {out:?}");
    // Half of it.
    let (warning, out) = bake(&far_away(7.5, 8.5, "track")).expect("a room");
    assert!((0.3..0.7).contains(&out.share) && out.nearest_m < 7.6, "{out:?}");
    assert!(warning.is_some_and(|said| said.contains("where no track begins")));
    let (warning, out) = bake(GOOD).expect("a room");
    assert!(warning.is_none() && out.share == 0.0);
}

#[test]
fn a_track_begins_as_far_away_as_the_bake_says() {
    use lighthouse_mote::track::{Config, Pose, Room, State, start};
    // Both look straight down; A stands at the origin.
    let ahead = |m: f64| {
        let pose = |x: i32| Pose {
            axes: nalgebra::Matrix3::new(1 << 15, 0, 0, 0, -(1 << 15), 0, 0, 0, -(1 << 15)),
            position: nalgebra::Vector3::new(x << 24, 0, 0),
        };
        let room = Room { stations: [pose(0), pose(1)] };
        let position = [1 << 15, 0, (-m * 65_536.0).round() as i32];
        start(&Config::HAND_HELD, &room, &mut State::default(), position, 0)
    };
    assert!(ahead(quantise::TRACK_REACH_M - 0.01) && !ahead(quantise::TRACK_REACH_M + 0.01));
}

#[test]
fn stations_that_look_away_from_each_other_light_nothing() {
    let away = "rotation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\nposition = [0, 0, 1]\n";
    let back = "rotation = [[-1, 0, 0], [0, 1, 0], [0, 0, -1]]\nposition = [0, 0, -1]\n";
    let text = format!("[station.A]\n{away}[station.B]\n{back}");
    let calibration = schema::read("room.toml", &text).expect("a file that reads");
    let said = firmware::bake("room.toml", &calibration).expect_err("no common light").to_string();
    assert!(said.contains("light no common point"), "{said}");
}

#[test]
fn a_mote_s_own_settings_go_before_those_of_the_room() {
    let mote = Mote::default().with("own", "id = 7\nestimate = \"fix\"").expect("good lines");
    assert_eq!((mote.id, mote.estimate, mote.pan), (7, Estimate::Fix, Mote::default().pan));
    let said = Mote::default().with("own", "id = 7\nidd = 8").expect_err("a typo").to_string();
    assert!(said.starts_with("own:2: idd: unknown"), "{said}");
}

#[test]
fn factory_terms_are_the_files_unless_somebody_asks() {
    let received = |text: &str| schema::read("room.toml", text).expect("a good file").received();
    assert_eq!(received(GOOD), [false, false]);
    assert_eq!(received(&with("[mote]", "[mote]\nfactory = \"received\"")), [true, true]);
    assert_eq!(
        received(&with("[station.A.factory.az]", "[station.A.factory]\nsource = \"received\"\n[station.A.factory.az]")),
        [true, false]
    );
    let terms = "[station.B.factory.az]\nphase = 0.015264\n[station.B.factory.el]\nphase = 0.020820\n";
    let bare = with(terms, "");
    assert_eq!(received(&bare.replace("[station.B]", "[station.B]\nfactory = \"received\"")), [false, true]);
    let both = bare
        .replace("[station.B]", "[station.B]\nfactory = \"file\"")
        .replace("[mote]", "[mote]\nfactory = \"received\"");
    assert_eq!(received(&both), [true, false]);
    let calibration = schema::read("room.toml", &both).expect("a good file");
    assert_eq!(calibration.stations[1].factory, [schema::Rotor::default(); 2]);
    let source = firmware::source("room.toml", &calibration).expect("a room that can be held");
    assert!(source.contains(".with_received([true, false])"), "{source}");
}

#[test]
fn a_wish_that_nobody_knows_is_refused() {
    let line = line_of("[mote]") + 1;
    assert_eq!(
        complaint(&with("[mote]", "[mote]\nfactory = \"guessed\"")),
        format!("room.toml:{line}: mote.factory: \"guessed\" is neither \"file\" nor \"received\"")
    );
}

#[test]
fn a_serial_number_is_32_bits() {
    let ids = |text: &str| schema::read("room.toml", text).expect("a good file").stations.map(|station| station.id);
    assert_eq!(ids(GOOD), [None, None]);
    let named = with("[station.A]", "[station.A]\nid = 3_200_290_360");
    assert_eq!(ids(&named), [Some(3_200_290_360), None]);
    let calibration = schema::read("room.toml", &named).expect("a good file");
    let source = firmware::source("room.toml", &calibration).expect("a room that can be held");
    assert!(source.contains("ids: [Some(3200290360), None]"), "{source}");
    let line = line_of("[station.A]") + 1;
    assert_eq!(
        complaint(&with("[station.A]", "[station.A]\nid = 4294967296")),
        format!("room.toml:{line}: station.A.id: 4294967296 is no whole number in 0 ..= 4294967295")
    );
}

#[test]
fn nothing_in_a_room_s_provenance_ends_its_line() {
    let text = with("residual_deg = 0.15", "\"a\\npub fn x( {\" = \"c\\u2028d\"");
    let calibration = schema::read("room\nfn y( {", &text).expect("a good file");
    let source = firmware::source("room\nfn y( {", &calibration).expect("a room that can be held");
    let comments = source.lines().take_while(|line| line.starts_with("//")).count();
    assert_eq!(comments, 5, "{source}");
    assert!(source.contains("// a pub fn x( {: \"c"), "{source}");
    assert!(source.lines().nth(5).is_some_and(|line| line.starts_with("pub const CONFIG")), "{source}");
}

#[test]
fn nobody_who_reads_what_is_printed_is_no_trouble() {
    use std::process::{Command, Stdio};
    let mut child = Command::new(env!("CARGO_BIN_EXE_xtask"))
        .args(["bake", concat!(env!("CARGO_MANIFEST_DIR"), "/../calib/default.toml")])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("xtask");
    drop(child.stdout.take());
    let end = child.wait_with_output().expect("an end");
    let said = String::from_utf8_lossy(&end.stderr);
    assert!(end.status.success() && said.is_empty(), "{:?} {said}", end.status);
}

/// What a build includes of a room.
fn source(text: &str) -> String {
    let calibration = schema::read("room.toml", text).expect("a good file");
    firmware::source("room.toml", &calibration).expect("a room that can be held")
}

#[test]
fn a_receiver_with_one_good_edge_is_named_by_the_room() {
    assert!(source(GOOD).contains("shortest_sweep: 1,") && source(GOOD).contains("Stamp::Middle"));
    // 5 us are 4.9 units of 1/8192 half turn.
    let named = source(&with("[mote]", "[mote]\nsweep_edge = \"rise\"\nshortest_sweep_us = 5"));
    assert!(named.contains("shortest_sweep: 5,") && named.contains("lighthouse_mote::sweep::Stamp::Rise"));
    let said = complaint(&with("[mote]", "[mote]\nsweep_edge = \"fall\""));
    assert!(said.ends_with("mote.sweep_edge: \"fall\" is neither \"middle\" nor \"rise\""), "{said}");
    let said = complaint(&with("[mote]", "[mote]\nshortest_sweep_us = 60"));
    assert!(said.ends_with("mote.shortest_sweep_us: 60 us is not in 0 ..= 50"), "{said}");
}

#[test]
fn a_lone_station_is_named_by_the_room_or_by_nobody() {
    assert!(source(GOOD).contains("lone: None"));
    let named = with("[mote]", "[mote]\nlone = \"B\"");
    assert!(source(&named).contains("lone: Some(lighthouse_mote::sweep::Station::B)"));
    let own = Mote::default().with("own", "lone = \"A\"").expect("a good line");
    assert_eq!(own.lone, Some(schema::Name::A));
    let said = complaint(&with("[mote]", "[mote]\nlone = \"C\""));
    assert!(said.ends_with("mote.lone: \"C\" is neither \"A\" nor \"B\""), "{said}");
}
