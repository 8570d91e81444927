//! Edits and what is made of portraits: colours, painted maps, directions, undoing, pages, stereo pairs, animations.

use std::{env, fs, path::PathBuf, process::Command};

use cnerf_tests::{DATA, Folder, MODEL, MODEL_SIZE, has_content, number};
use image::{AnimationDecoder as _, codecs::png::PngDecoder, imageops};

/// A folder with `portrait.cnerf`, inverted from a picture of the shared dataset.
fn folder_with_portrait(name: &str) -> Folder {
    let folder = Folder::with_model(name);
    fs::copy(folder.path(DATA).join("images/00003.png"), folder.path("portrait.png")).unwrap();
    let few = "--aligned --pivot-steps 20 --tune-steps 2 --overwrite --out .";
    folder.json(&format!("invert portrait.png --model {MODEL} {few}"));
    folder
}

/// The program `name` on PATH.
fn program(names: &[&str]) -> Option<PathBuf> {
    let path = env::var_os("PATH")?;
    env::split_paths(&path)
        .flat_map(|folder| names.iter().map(move |name| folder.join(name)))
        .find(|file| file.is_file())
}

/// Bytes of the thumbnail in the portrait file `name`.
fn thumbnail(folder: &Folder, name: &str) -> Vec<u8> {
    let bytes = folder.read(name);
    safetensors::SafeTensors::deserialize(&bytes).unwrap().tensor("thumbnail").unwrap().data().to_vec()
}

#[test]
fn a_colour_is_given_by_region_and_taken_back() {
    let folder = folder_with_portrait("colour");
    let line = format!("edit portrait.cnerf --model {MODEL}");
    let report = folder.json(&format!("{line} --color face=#b08060 --out face.cnerf"));
    // What this tiny model can reach is limited; that it measures and moves no depth is not.
    assert!(number(&report, "colour_difference").is_finite());
    assert_eq!(number(&report, "depth_change"), 0.0, "{report}");
    assert!(number(&report, "inside_change") > number(&report, "outside_change"), "{report}");
    assert!(thumbnail(&folder, "face.cnerf") != thumbnail(&folder, "portrait.cnerf"));

    folder.json(&format!("edit face.cnerf --model {MODEL} --undo --out back.cnerf"));
    assert!(thumbnail(&folder, "back.cnerf") == thumbnail(&folder, "portrait.cnerf"), "undo restores the thumbnail");
    assert!(has_content(&folder.picture("back.png")), "before, after and regions");
    let run = folder.run(&format!("edit back.cnerf --model {MODEL} --undo --out again.cnerf"));
    assert_eq!(run.code, 2);
    assert!(run.stderr.contains("back.cnerf: has no edit to undo"), "{}", run.stderr);
}

#[test]
fn a_repainted_map_moves_the_shapes() {
    let folder = folder_with_portrait("paint");
    let line = format!("edit portrait.cnerf --model {MODEL}");
    folder.json(&format!("{line} --mask-write --out map.png"));
    let mut map = folder.picture("map.png");
    assert_eq!(map.dimensions(), (MODEL_SIZE, MODEL_SIZE));
    // The map moved down by two pixels.
    let moved = imageops::crop_imm(&map, 0, 0, MODEL_SIZE, MODEL_SIZE - 2).to_image();
    imageops::replace(&mut map, &moved, 0, 2);
    map.save(folder.path("painted.png")).unwrap();
    let report = folder.json(&format!("{line} --mask-paint painted.png --out moved.cnerf"));
    assert!(number(&report, "depth_change") > 0.0, "{report}");
    let info = folder.json("info moved.cnerf");
    assert_eq!(info["edits"][0]["edit"]["source"]["painted"], "painted.png", "{info}");
    let run = folder.run(&format!("{line} --mask-paint map.png --out same.cnerf"));
    assert_eq!((run.code, run.stderr.lines().count()), (2, 1), "{}", run.stderr);
    assert!(run.stderr.contains("repaint"), "{}", run.stderr);
}

#[test]
fn directions_are_previewed_and_followed() {
    let folder = folder_with_portrait("directions");
    let line = format!("edit portrait.cnerf --model {MODEL}");
    folder.json(&format!("{line} --region face --directions 2 --out sheet.png"));
    let sheet = folder.picture("sheet.png");
    assert!(has_content(&sheet) && sheet.width() > 5 * MODEL_SIZE && sheet.height() > 2 * MODEL_SIZE);
    let go = |amount: &str, out: &str| {
        let report = folder.json(&format!("{line} --region face --direction 1 --amount {amount} --out {out}"));
        number(&report, "inside_change")
    };
    let (little, much) = (go("0.5", "little.cnerf"), go("-3", "much.cnerf"));
    assert!(much > little && little > 0.0, "{little} {much}");
    let run = folder.run(&format!("{line} --region face --direction 9999 --out far.cnerf"));
    assert_eq!((run.code, run.stderr.lines().count()), (2, 1), "{}", run.stderr);
}

#[test]
fn all_but_the_hair_comes_from_another() {
    let folder = folder_with_portrait("all_but");
    let rest = "background,face,eyes,eyebrows,mouth,nose,ears,neck";
    let line = format!("edit portrait.cnerf --model {MODEL} --region {rest} --seed 3 --out other.cnerf");
    assert!(number(&folder.json(&line), "inside_change") > 0.0);
    let codes = |name: &str| {
        let bytes = folder.read(name);
        safetensors::SafeTensors::deserialize(&bytes).unwrap().tensor("codes").unwrap().data().to_vec()
    };
    let (before, after) = (codes("portrait.cnerf"), codes("other.cnerf"));
    let region = before.len() / 9;
    for index in 0..9 {
        let row = index * region..(index + 1) * region;
        assert_eq!(before[row.clone()] == after[row], index == 7, "region {index}");
    }
}

#[test]
fn a_page_turns_the_head_and_hides_regions() {
    let folder = folder_with_portrait("page");
    let report = folder.json(&format!("render portrait.cnerf --model {MODEL} --grid 5x3 --html head.html"));
    assert_eq!(report["frames"], 15);
    let page = String::from_utf8(folder.read("head.html")).unwrap();
    assert!(page.len() < 4_000_000 && !page.contains("http"), "self-contained");
    let again = folder.run(&format!("render portrait.cnerf --model {MODEL} --html head.html"));
    assert_eq!(again.code, 2, "not overwritten unasked");
    let Some(browser) = program(&["chromium", "chromium-browser", "google-chrome"]) else {
        println!("skipped: no Chromium on PATH (apt install chromium)");
        return;
    };
    // What a person does, and what they see after it.
    let hands = r##"<script>(async () => {
        const wait = () => new Promise(done => setTimeout(done, 1000));
        while (!document.documentElement.dataset.ready) await wait();
        const view = document.getElementById("view"), box = view.getBoundingClientRect(), seen = {};
        const look = name => {
            const data = view.getContext("2d").getImageData(0, 0, view.width, view.height).data;
            let sum = 0, clear = 0;
            for (let at = 0; at < data.length; at += 4) {
                sum = (sum * 31 + data[at] * 7 + data[at + 1] * 3 + data[at + 2]) % 1000000007;
                clear += data[at + 3] === 0;
            }
            seen[name] = { sum, clear };
        };
        const point = (type, x) => view.dispatchEvent(new PointerEvent(type,
            { bubbles: true, pointerId: 1, clientX: box.left + x * box.width, clientY: box.top + 0.5 * box.height }));
        const press = key => view.dispatchEvent(new KeyboardEvent("keydown", { bubbles: true, key }));
        await wait(); look("start");
        point("pointerdown", 0.5); point("pointermove", 0.2); point("pointerup", 0.2); await wait(); look("dragged");
        point("pointermove", 0.9); await wait(); look("released");
        press("0"); await wait(); look("straight");
        press("ArrowRight"); await wait(); look("arrow");
        document.getElementById("front").click(); await wait();
        for (const layer of ["regions", "depth", "normal", "portrait"]) {
            document.querySelector(`[data-layer=${layer}]`).click(); await wait(); look(layer);
        }
        document.querySelector("#regions input").click(); await wait(); look("hidden");
        document.getElementById("none").click(); await wait(); look("none");
        document.getElementById("all").click(); await wait(); look("all");
        seen.errors = window.errors || 0;
        document.body.insertAdjacentHTML("beforeend", `<pre id="seen">${JSON.stringify(seen)}</pre>`);
    })().catch(error => document.body.insertAdjacentHTML("beforeend", `<pre id="seen">${error}</pre>`));</script></body>"##;
    // The clock of a headless browser runs ahead of its frames: both on one clock.
    let clock = "<body><script>window.requestAnimationFrame = draw => setTimeout(draw, 16);</script>";
    let test = page.replace("<body>", clock).replace("</body>", hands);
    folder.write("test.html", test.as_bytes());
    let profile = format!("--user-data-dir={}", folder.path("browser").display());
    let output = Command::new(&browser)
        .args(["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", &profile])
        .args(["--window-size=1100,800", "--virtual-time-budget=400000", "--dump-dom"])
        .arg(format!("file://{}", folder.path("test.html").display()))
        .output()
        .unwrap();
    // What is there as soon as the page has loaded: the head, and nothing missing.
    let shot = Command::new(&browser)
        .args(["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", &profile, "--window-size=1100,800"])
        .arg(format!("--screenshot={}", folder.path("shot.png").display()))
        .arg(format!("file://{}", folder.path("head.html").display()))
        .output()
        .unwrap();
    let _ = fs::remove_dir_all(folder.path("browser"));
    assert!(shot.status.success(), "{}", String::from_utf8_lossy(&shot.stderr));
    let shot = folder.picture("shot.png");
    let stage = imageops::crop_imm(&shot, 100, 250, 400, 300).to_image();
    assert!(has_content(&stage), "a page that has just loaded shows the head");
    let text = String::from_utf8_lossy(&output.stdout);
    let seen = text
        .rsplit("<pre id=\"seen\">")
        .next()
        .filter(|_| text.contains("data-ready"))
        .and_then(|rest| rest.split("</pre>").next());
    let seen = seen.unwrap_or_else(|| panic!("the page never got ready: {}", String::from_utf8_lossy(&output.stderr)));
    let seen: serde_json::Value = serde_json::from_str(seen).unwrap_or_else(|_| panic!("{seen}"));
    let sum = |name: &str| number(&seen[name], "sum");
    let clear = |name: &str| number(&seen[name], "clear");
    assert!(sum("dragged") != sum("start"), "a drag turns the head: {seen}");
    assert!(sum("released") == sum("dragged"), "a pointer that is up turns nothing: {seen}");
    assert!(sum("straight") == sum("start"), "0 turns it back: {seen}");
    assert!(sum("arrow") != sum("start"), "arrow keys turn it: {seen}");
    for layer in ["regions", "depth", "normal"] {
        assert!(sum(layer) != sum("start"), "layer {layer} shows something else: {seen}");
    }
    assert!(sum("portrait") == sum("start"), "{seen}");
    assert_eq!(clear("start"), 0.0, "{seen}");
    assert!(clear("hidden") > 1000.0 && clear("none") == 512.0 * 512.0 && sum("all") == sum("start"), "{seen}");
}

#[test]
fn two_eyes_see_two_views() {
    let folder = folder_with_portrait("stereo");
    let line = format!("render portrait.cnerf --model {MODEL} --trajectory front");
    folder.json(&format!("{line} --out front.png"));
    folder.json(&format!("{line} --stereo side --out side.png"));
    let side = folder.picture("side.png");
    assert_eq!(side.dimensions(), (2 * MODEL_SIZE, MODEL_SIZE));
    let eye = |left: u32| imageops::crop_imm(&side, left, 0, MODEL_SIZE, MODEL_SIZE).to_image();
    assert!(eye(0) != eye(MODEL_SIZE) && eye(0) != folder.picture("front.png"));
    folder.json(&format!("{line} --stereo anaglyph --out anaglyph.png"));
    let anaglyph = folder.picture("anaglyph.png");
    assert!(anaglyph.pixels().zip(eye(MODEL_SIZE).pixels()).all(|(both, right)| both.0[1..] == right.0[1..]));
}

#[test]
fn animations_are_what_their_names_say() {
    let folder = folder_with_portrait("animations");
    let line = format!("render portrait.cnerf --model {MODEL} --frames 3");
    folder.json(&format!("{line} --out orbit.apng"));
    let decoder = PngDecoder::new(std::io::Cursor::new(folder.read("orbit.apng"))).unwrap();
    assert!(decoder.is_apng().unwrap());
    assert_eq!(decoder.apng().unwrap().into_frames().collect_frames().unwrap().len(), 3);

    if program(&["ffmpeg"]).is_some() {
        folder.json(&format!("{line} --out orbit.mp4"));
        assert_eq!(&folder.read("orbit.mp4")[4..8], b"ftyp");
    } else {
        println!("skipped: no ffmpeg on PATH for .mp4");
    }
    // Without ffmpeg: one line that says so, and nothing written.
    let mut command = folder.command(&format!("{line} --out without.mp4"));
    let output = command.env("PATH", folder.path("")).output().unwrap();
    let error = String::from_utf8_lossy(&output.stderr);
    let last = error.lines().last().unwrap_or_default();
    assert_eq!(output.status.code(), Some(2), "{error}");
    assert!(last.contains("ffmpeg") && last.contains(".gif"), "{error}");
    assert!(!folder.path("without.mp4").exists());
}

#[test]
fn a_glb_has_one_node_a_region() {
    let folder = folder_with_portrait("glb");
    folder.json(&format!("export portrait.cnerf --model {MODEL} --resolution 32 --out head.glb"));
    let glb = folder.read("head.glb");
    let length = u32::from_le_bytes(glb[12..16].try_into().unwrap()) as usize;
    let scene: serde_json::Value = serde_json::from_slice(&glb[20..20 + length]).unwrap();
    let names: Vec<&str> = scene["nodes"].as_array().unwrap().iter().filter_map(|node| node["name"].as_str()).collect();
    let known = ["background", "face", "eyes", "eyebrows", "mouth", "nose", "ears", "hair", "neck"];
    assert!(names.len() > 1 && names.iter().all(|name| known.contains(name)), "{names:?}");
    let mut distinct = names.clone();
    distinct.sort_unstable();
    distinct.dedup();
    assert_eq!(distinct.len(), names.len(), "{names:?}");
}
