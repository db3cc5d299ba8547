//! The registry: policies by name, from this crate, from any other that is linked, and added while the program runs.
//!
//! [`register_policy!`](crate::register_policy) registers a policy where it is defined; there is no central
//! list. The linker drops crates that are never named, so the main file of a program that uses an outside
//! crate of policies says `use my_policies as _;`. Policies of another language are [added](add) at run time.

mod added;

pub use added::{PolicyFactory, add, import, set_importer};

use std::fmt;
use std::marker::PhantomData;

use serde::Serialize;
use serde::de::DeserializeOwned;
use toml::{Table, Value};

use crate::parameters::{StepParameter, field_names, nearest, scale_steps};
use crate::policy::{DensityPolicy, PolicyError, PolicyResult, SceneInfo};

#[doc(hidden)]
pub use inventory;

/// A policy that can be built from a table of parameters.
pub trait ConfiguredPolicy: DensityPolicy + Sized + 'static {
    /// The parameters: a struct with `#[serde(deny_unknown_fields, default)]`. Use `f64`, `u32`, `bool`
    /// and enums without data, so that defaults print as written. The parameters of another policy can be a
    /// field with `#[serde(flatten)]`; then leave out `deny_unknown_fields`, which serde does not support
    /// together with it. Unknown names are refused in any case.
    type Params: Serialize + DeserializeOwned + Default;

    /// Integer parameters that count steps. Their defaults are for a run of 30,000 steps and scale with the
    /// length of the run; values set by the user do not. An [`Interval`](StepParameter::Interval) does not
    /// shrink below 100 steps (or below its default, if that is less).
    const STEP_PARAMETERS: &'static [StepParameter] = &[];

    /// Parameters that were added after runs had been saved without them, each with the value that stands for what these
    /// runs did. A saved run that lacks the parameter is resumed and repeated with this value, not with the default.
    const ADDED_PARAMETERS: &'static [(&'static str, &'static str)] = &[];

    /// Replaces choices that are left to the scene by what is chosen in `scene`, so that the file of a run names it.
    #[must_use]
    fn decided(params: Self::Params, _scene: &SceneInfo) -> Self::Params {
        params
    }

    /// Builds the policy. Check ranges here, with [`in_range`](crate::parameters::in_range).
    ///
    /// # Errors
    /// [`PolicyError::BadParameter`] when a value is out of range.
    fn new(params: Self::Params, scene: &SceneInfo) -> PolicyResult<Self>;
}

/// Registers a policy under a name.
///
/// `doc` is the text of the defining file, `include_str!("this_file.rs")`; its leading `//!` block is the
/// manual page. (A text without such a block is itself the manual page.) The [crate documentation](crate)
/// has an example.
#[macro_export]
macro_rules! register_policy {
    ($name:expr, $policy:ty, summary: $summary:expr, source: $source:expr, doc: $doc:expr $(,)?) => {
        $crate::registry::inventory::submit! {
            $crate::registry::PolicyEntry::new::<$policy>(
                $name,
                $summary,
                $source,
                $doc,
                (::core::file!(), ::core::line!()),
            )
        }
    };
}

inventory::collect!(PolicyEntry);

/// A registered policy.
#[derive(Clone, Copy)]
pub struct PolicyEntry {
    /// Name, as given on the command line.
    pub name: &'static str,
    /// One-line description.
    pub summary: &'static str,
    /// The publication that the policy is from.
    pub source: &'static str,
    doc: &'static str,
    place: (&'static str, u32),
    step_parameters: &'static [StepParameter],
    added_parameters: &'static [(&'static str, &'static str)],
    factory: &'static dyn PolicyFactory,
}

impl fmt::Debug for PolicyEntry {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("PolicyEntry").field("name", &self.name).field("place", &self.place).finish()
    }
}

/// Builds policies of the type `P`.
struct Configured<P>(PhantomData<fn() -> P>);

impl<P: ConfiguredPolicy> PolicyFactory for Configured<P> {
    fn parameter_names(&self) -> Vec<String> {
        let known = field_names::<P::Params>().unwrap_or_default();
        known.iter().map(|name| (*name).to_owned()).collect()
    }

    fn defaults(&self) -> Result<Table, String> {
        Table::try_from(P::Params::default()).map_err(first_line)
    }

    fn typed(&self, table: Table) -> Result<Table, String> {
        let params: P::Params = table.try_into().map_err(first_line)?;
        Table::try_from(params).map_err(first_line)
    }

    fn decided(&self, table: Table, scene: &SceneInfo) -> Result<Table, String> {
        let params: P::Params = table.try_into().map_err(first_line)?;
        Table::try_from(P::decided(params, scene)).map_err(first_line)
    }

    fn build(&self, table: Table, scene: &SceneInfo) -> PolicyResult<Box<dyn DensityPolicy>> {
        let params = table.try_into().map_err(|e| PolicyError::Other(first_line(e)))?;
        Ok(Box::new(P::new(params, scene)?))
    }
}

impl PolicyEntry {
    /// The entry of policy `P`; called by [`register_policy!`](crate::register_policy).
    pub const fn new<P: ConfiguredPolicy>(
        name: &'static str,
        summary: &'static str,
        source: &'static str,
        doc: &'static str,
        place: (&'static str, u32),
    ) -> Self {
        let (step_parameters, added_parameters) = (P::STEP_PARAMETERS, P::ADDED_PARAMETERS);
        let factory = const { &Configured::<P>(PhantomData) };
        Self { name, summary, source, doc, place, step_parameters, added_parameters, factory }
    }

    /// The place where the policy is registered (file:line).
    pub fn location(&self) -> String {
        format!("{}:{}", self.place.0, self.place.1)
    }

    /// The manual page: the leading `//!` block of the file that defines the policy.
    pub fn manual(&self) -> String {
        let block: Vec<&str> = self
            .doc
            .lines()
            .map_while(|line| line.trim_end().strip_prefix("//!"))
            .map(|line| line.strip_prefix(' ').unwrap_or(line))
            .collect();
        let text = if block.is_empty() { self.doc.to_owned() } else { block.join("\n") };
        text.trim().to_owned() + "\n"
    }

    /// See [`PolicyFactory::provenance`].
    pub fn provenance(&self) -> Option<String> {
        self.factory.provenance()
    }

    /// The parameters that count steps and scale with the run's length.
    pub fn step_parameters(&self) -> &'static [StepParameter] {
        self.step_parameters
    }

    /// See [`ConfiguredPolicy::ADDED_PARAMETERS`].
    pub fn added_parameters(&self) -> &'static [(&'static str, &'static str)] {
        self.added_parameters
    }

    /// Names of all parameters, in declaration order.
    pub fn parameter_names(&self) -> Vec<String> {
        let mut names = self.factory.parameter_names();
        for (name, _) in self.defaults().unwrap_or_default() {
            if !names.contains(&name) {
                names.push(name);
            }
        }
        names
    }

    /// Names and defaults for a run of 30,000 steps, in declaration order. Parameters that are `None` by
    /// default are not listed, as TOML has no such value. Empty if the defaults cannot be written as TOML;
    /// [`build`](Self::build) then returns the error.
    pub fn parameters(&self) -> Vec<(String, Value)> {
        let mut defaults = self.defaults().unwrap_or_default();
        let known = self.factory.parameter_names();
        let in_order = known.iter().filter_map(|name| defaults.remove_entry(name.as_str()));
        let mut listed: Vec<(String, Value)> = in_order.collect();
        listed.extend(defaults);
        listed
    }

    /// The parameters of a run: the defaults, scaled to its length, overridden by `set`, with
    /// [decisions](ConfiguredPolicy::decided) for this scene. Ranges are checked by [`build`](Self::build).
    ///
    /// # Errors
    /// [`PolicyError::UnknownParameter`]; [`PolicyError::BadParameter`] for a wrong type.
    pub fn effective(&self, set: &Table, scene: &SceneInfo) -> PolicyResult<Table> {
        let mut table = self.defaults()?;
        for parameter in set.keys() {
            self.check_known(parameter)?;
        }
        scale_steps(&mut table, self.step_parameters, scene.iterations);
        for (parameter, value) in set {
            // One at a time, so that the error can name the parameter.
            table.insert(parameter.clone(), value.clone());
            self.factory.typed(table.clone()).map_err(|reason| PolicyError::BadParameter {
                policy: self.name.to_owned(),
                parameter: parameter.clone(),
                reason: format!("{value} does not fit: {reason}"),
            })?;
        }
        self.factory.decided(table, scene).map_err(|reason| self.bad_defaults(&reason))
    }

    /// Builds the policy with the parameters in `set` and [effective](Self::effective) defaults.
    ///
    /// # Errors
    /// [`PolicyError::UnknownParameter`]; [`PolicyError::BadParameter`] for a wrong type or a
    /// value out of range; any other error of the policy.
    pub fn build(&self, set: &Table, scene: &SceneInfo) -> PolicyResult<Box<dyn DensityPolicy>> {
        self.factory.build(self.effective(set, scene)?, scene).map_err(|error| match error {
            PolicyError::BadParameter { parameter, reason, .. } => {
                PolicyError::BadParameter { policy: self.name.to_owned(), parameter, reason }
            }
            other => other,
        })
    }

    fn check_known(&self, parameter: &str) -> PolicyResult {
        let known = self.parameter_names();
        if known.iter().any(|name| name == parameter) {
            return Ok(());
        }
        Err(PolicyError::UnknownParameter {
            policy: self.name.to_owned(),
            parameter: parameter.to_owned(),
            nearest: nearest(parameter, known.iter().map(String::as_str)),
        })
    }

    fn defaults(&self) -> PolicyResult<Table> {
        self.factory.defaults().map_err(|reason| self.bad_defaults(&reason))
    }

    fn bad_defaults(&self, reason: &str) -> PolicyError {
        PolicyError::Other(format!(
            "policy `{}` ({}) has defaults that do not fit its parameters: {reason}",
            self.name,
            self.location()
        ))
    }
}

/// All policies, sorted by name, as the order of the linker and of additions is arbitrary.
///
/// # Errors
/// [`PolicyError::DuplicateName`] when two have the same name.
pub fn policies() -> PolicyResult<Vec<&'static PolicyEntry>> {
    sorted(linked().chain(added::all()).collect())
}

/// The policy of this name.
///
/// # Errors
/// [`PolicyError::UnknownPolicy`] with the nearest name; [`PolicyError::DuplicateName`].
pub fn find(name: &str) -> PolicyResult<&'static PolicyEntry> {
    let all = policies()?;
    all.iter().find(|entry| entry.name == name).copied().ok_or_else(|| PolicyError::UnknownPolicy {
        name: name.to_owned(),
        nearest: nearest(name, all.iter().map(|entry| entry.name)),
    })
}

/// The policies that are part of the program.
fn linked() -> impl Iterator<Item = &'static PolicyEntry> {
    inventory::iter::<PolicyEntry>.into_iter()
}

fn sorted(mut entries: Vec<&PolicyEntry>) -> PolicyResult<Vec<&PolicyEntry>> {
    entries.sort_by_key(|entry| (entry.name, entry.place));
    match entries.windows(2).find(|pair| pair[0].name == pair[1].name) {
        None => Ok(entries),
        Some(pair) => Err(PolicyError::DuplicateName {
            name: pair[0].name.to_owned(),
            first: pair[0].location(),
            second: pair[1].location(),
        }),
    }
}

fn first_line(error: impl ToString) -> String {
    error.to_string().lines().next().unwrap_or_default().to_owned()
}

#[cfg(test)]
mod tests;
