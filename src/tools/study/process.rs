//! Starts `densify` in child processes, so that measured memory is that of a single run.

use std::path::Path;
use std::process::{Command, Stdio};

use densify_core::files::write_atomically;
use densify_launch::program_command;
use densify_run::failure::{Failure, OTHER};
use densify_run::{Partial, RunSpec};

/// Trains a run in a folder.
pub(super) fn train(spec: &Partial, folder: &Path) -> Result<(), Failure> {
    // The extension is appended, not replaced: the name may contain a dot.
    let mut file = folder.as_os_str().to_owned();
    file.push(".toml");
    let text = toml::to_string(spec).map_err(Failure::input)?;
    write_atomically(Path::new(&file), |out| out.write_all(text.as_bytes()))?;
    let mut command = program_command()?;
    command.arg("train").arg("--config").arg(file).args(["--overwrite", "--quiet", "--output"]);
    wait_for(command.arg(folder))
}

/// Evaluates a trained run with `densify eval`, on the device that trained it.
pub(super) fn evaluate(spec: &Partial, folder: &Path) -> Result<(), Failure> {
    let RunSpec { start, device, .. } = spec.clone().describe()?;
    let mut command = program_command()?;
    command.arg("eval").arg(folder);
    command.arg("--scene").arg(start.scene.unwrap_or_default());
    command.args(["--backend", device.backend.word()]);
    if let Some(name) = device.gpu {
        command.args(["--gpu", &name]);
    }
    if let Some(threads) = device.threads {
        command.args(["--threads", &threads.0.to_string()]);
    }
    wait_for(&mut command)
}

fn wait_for(command: &mut Command) -> Result<(), Failure> {
    let not_started = |error| Failure::new(OTHER, format!("cannot start a run: {error}"));
    let output =
        command.stdin(Stdio::null()).stdout(Stdio::null()).output().map_err(not_started)?;
    if output.status.success() {
        return Ok(());
    }
    let message = String::from_utf8_lossy(&output.stderr);
    let code = output.status.code().and_then(|code| u8::try_from(code).ok());
    Err(Failure::new(code.unwrap_or(OTHER), message.trim().trim_start_matches("error: ")))
}
