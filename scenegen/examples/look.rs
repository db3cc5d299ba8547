#![allow(clippy::print_stderr, clippy::print_stdout, missing_docs)]
use densify_scenegen::*;
fn main() {
    let mut args = std::env::args().skip(1);
    let (input, out) = (args.next().unwrap(), args.next().unwrap());
    let source =
        if input.contains('.') { Source::File(input.into()) } else { Source::Preset(input) };
    let size: u32 = args.next().and_then(|s| s.parse().ok()).unwrap_or(0);
    let mut o = Options { size: (size > 0).then_some((size, size)), ..Options::default() };
    for a in args {
        if a == "inside" {
            o.rig = Some(RigKind::Inside)
        } else if a == "file" {
            o.rig = Some(RigKind::File)
        }
    }
    let t = std::time::Instant::now();
    match Scene::prepare(&source, &o) {
        Ok(scene) => {
            let p = t.elapsed();
            let (w, h, px) = contact_sheet(&scene);
            write_png(out.as_ref(), w, h, &px).unwrap();
            println!(
                "{} tris {} prep {:?} (bvh {:.2}) render8 {:?} exposure {} req {:?} notes {:?}",
                scene.name,
                scene.surface.len(),
                p,
                scene.surface.build_seconds(),
                t.elapsed() - p,
                scene.exposure,
                scene.requirements,
                scene.model.notes
            );
        }
        Err(e) => {
            println!("ERROR {e}");
        }
    }
}
