use super::*;
#[test]
fn explore() {
    let var = |name: &str, default: &str| std::env::var(name).unwrap_or(default.to_owned());
    let number = |name: &str, default: &str| var(name, default).parse::<usize>().unwrap();
    for preset in var("PRESETS", "spheres").split(',') {
        let name: &'static str = preset.to_owned().leak();
        let start = std::time::Instant::now();
        let known = Known::new(name, number("SIDE", "96") as u32, number("POINTS", "400"));
        eprintln!("generated in {:?}, {} points", start.elapsed(), known.dataset.points.len());
        for policy in var("POLICIES", "vanilla,diet").split(',') {
            for seed in 0..number("SEEDS", "1") as u64 {
                let start = std::time::Instant::now();
                let (policy, set) = policy.split_once(':').unwrap_or((policy, ""));
                let set = set.replace(';', "\n");
                known.train(Run {
                    policy,
                    set: &set,
                    budget: number("BUDGET", "1500"),
                    iterations: number("ITER", "600") as u32,
                    seed,
                });
                eprintln!("   {:?} {set:?}", start.elapsed());
            }
        }
    }
}
