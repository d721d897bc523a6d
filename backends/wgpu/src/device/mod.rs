//! Adapters, and the device that is opened on one of them.

pub(crate) mod kernel;
pub(crate) mod layout;
pub(crate) mod memory;
pub(crate) mod probed;
pub(crate) mod status;
pub(crate) mod uniforms;

use barchan_core::{Error, Result};
use std::collections::BTreeMap;
use std::sync::atomic::AtomicU64;
use std::sync::{Arc, LazyLock, Mutex, PoisonError};
use wgpu::{Adapter, AdapterInfo, DeviceType, Features, Limits};

/// Name of the backend in errors and on the command line.
pub const BACKEND: &str = "wgpu";
const ORIGIN: &str = "built-in";

/// What this backend lacks, why the scene asks for it, and what would mend it.
pub(crate) fn lacks(what: impl Into<String>, why: impl Into<String>, mend: &str) -> Error {
    Error::Missing {
        kind: "backend",
        name: BACKEND.into(),
        origin: ORIGIN.into(),
        what: what.into(),
        why: why.into(),
        mend: mend.into(),
    }
}

/// From so many particles on a device is busy: sorts that nobody needs take longer than steps that are written for nothing behind one that is missing, and
/// P2G's registers are scarcer than its time to wait.
pub(crate) const MANY: usize = 500_000;

/// Used where an adapter offers them; nothing needs them.
const WELCOME: Features = Features::SHADER_FLOAT32_ATOMIC
    .union(Features::SUBGROUP)
    .union(Features::SUBGROUP_BARRIER)
    .union(Features::TIMESTAMP_QUERY)
    .union(Features::TIMESTAMP_QUERY_INSIDE_ENCODERS)
    .union(Features::TIMESTAMP_QUERY_INSIDE_PASSES);

/// How much of what an adapter offers is taken.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Offer {
    /// Its own limits, and f32 atomics, subgroups and timestamps if it has them.
    #[default]
    All,
    /// WebGPU's default limits and no features: what the poorest adapter gives.
    Least,
}

/// An open device.
#[derive(Debug)]
pub struct Gpu {
    /// Makes buffers and pipelines.
    pub device: wgpu::Device,
    /// Takes commands.
    pub queue: wgpu::Queue,
    /// The adapter's name, type and driver.
    pub adapter_info: AdapterInfo,
    /// The limits that the device was opened with.
    pub limits: Limits,
    /// The features that the device was opened with.
    pub features: Features,
    fault: Arc<Mutex<Option<Fault>>>,
    /// What is read back passes through this.
    pub(crate) passage: Mutex<Option<wgpu::Buffer>>,
    /// How often something was read back that somebody asked for, and how many bytes in all.
    pub(crate) transferred: [AtomicU64; 2],
}

/// What went wrong with a device, and what would mend it.
#[derive(Clone, Debug)]
struct Fault {
    what: String,
    mend: &'static str,
}

const MEND_MEMORY: &str =
    "simulate fewer particles or a smaller grid, or choose an adapter with more memory (--adapter)";
const MEND_LOST: &str =
    "resume from the last snapshot; if it happens again, update the driver or choose another adapter (--adapter)";
const MEND_BUG: &str = "this is an error in Barchan: report it; the backend cpu runs the scene meanwhile";

/// All adapters, best first: discrete GPUs, integrated ones, virtual ones, software. The first is used unless another is
/// asked for.
pub fn adapters() -> Vec<AdapterInfo> {
    found().iter().map(Adapter::get_info).collect()
}

/// [`adapters`] as the registry lists them: kind, interface, driver, and what is used of what they offer.
pub fn list() -> Vec<barchan_core::backend::Adapter> {
    found().iter().map(describe).collect()
}

fn describe(adapter: &Adapter) -> barchan_core::backend::Adapter {
    let (info, limits, features) = (adapter.get_info(), adapter.limits(), adapter.features());
    let kind = match info.device_type {
        DeviceType::DiscreteGpu => "discrete GPU",
        DeviceType::IntegratedGpu => "integrated GPU",
        DeviceType::VirtualGpu => "virtual GPU",
        DeviceType::Cpu => "software",
        DeviceType::Other => "unknown kind",
    };
    let offers = [
        (Features::SHADER_FLOAT32_ATOMIC, "f32 atomics"),
        (Features::SUBGROUP, "subgroups"),
        (Features::TIMESTAMP_QUERY, "timestamps"),
    ];
    let offers = offers.iter().filter(|(feature, _)| features.contains(*feature)).map(|(_, name)| format!(", {name}"));
    barchan_core::backend::Adapter {
        doc: format!(
            "{kind}, {} ({} {}){}; bindings to {} MiB, {} storage buffers a stage, {} KiB of workgroup memory",
            info.backend,
            info.driver,
            info.driver_info,
            offers.collect::<String>(),
            limits.max_storage_buffer_binding_size >> 20,
            limits.max_storage_buffers_per_shader_stage,
            limits.max_compute_workgroup_storage_size >> 10,
        ),
        name: info.name,
    }
}

/// Opens the adapter that `choice` names by its number in [`adapters`], its name, or a part of its name in either case;
/// `None`: the first one.
///
/// # Errors
/// [`Error::Missing`] if there is no adapter, [`Error::Unknown`] if none, or not just one, is called so, and
/// [`Error::Device`] if the driver refuses.
pub fn open(choice: Option<&str>) -> Result<Gpu> {
    open_with(choice, Offer::All)
}

/// The adapter that `choice` names.
fn find(choice: Option<&str>) -> Result<Adapter> {
    let mut adapters = found();
    let infos: Vec<_> = adapters.iter().map(Adapter::get_info).collect();
    let names: Vec<_> = infos.iter().map(|info| info.name.as_str()).collect();
    Ok(adapters.swap_remove(choose(&names, choice)?))
}

fn limits_of(offered: Limits, offer: Offer) -> Limits {
    match offer {
        Offer::All => offered,
        // An adapter below WebGPU's defaults gives what it has.
        Offer::Least => Limits::defaults().or_worse_values_from(&offered),
    }
}

/// What a device is held to, without opening it. Adapters are looked for once a process: every world that is put into a batch asks.
///
/// # Errors
/// As [`open`], but for what drivers refuse.
pub fn limits(choice: Option<&str>, offer: Offer) -> Result<Limits> {
    static OFFERED: Mutex<BTreeMap<Option<String>, Limits>> = Mutex::new(BTreeMap::new());
    let mut offered = OFFERED.lock().unwrap_or_else(PoisonError::into_inner);
    let choice = choice.map(str::to_owned);
    let limits = match offered.get(&choice) {
        Some(limits) => limits.clone(),
        None => {
            let limits = find(choice.as_deref())?.limits();
            offered.entry(choice).or_insert(limits).clone()
        }
    };
    Ok(limits_of(limits, offer))
}

/// As [`open`], with as much of the adapter's offer as is asked for.
///
/// # Errors
/// As [`open`].
pub fn open_with(choice: Option<&str>, offer: Offer) -> Result<Gpu> {
    let adapter = find(choice)?;
    let features = match offer {
        Offer::All => adapter.features() & WELCOME,
        Offer::Least => Features::empty(),
    };
    let limits = limits_of(adapter.limits(), offer);
    let adapter_info = adapter.get_info();
    let request = adapter.request_device(&wgpu::DeviceDescriptor {
        label: Some("barchan"),
        required_features: features,
        required_limits: limits.clone(),
        experimental_features: wgpu::ExperimentalFeatures::disabled(),
        memory_hints: wgpu::MemoryHints::Performance,
        trace: wgpu::Trace::Off,
    });
    let (device, queue) = pollster::block_on(request).map_err(|error| Error::Device {
        backend: BACKEND.to_owned(),
        device: adapter_info.name.clone(),
        what: format!("the driver gives no device: {error}"),
        mend: "update the driver, or choose another adapter (--adapter)".to_owned(),
    })?;
    let fault = Arc::default();
    watch(&device, &fault);
    let (passage, transferred) = Default::default();
    Ok(Gpu { device, queue, adapter_info, limits, features, fault, passage, transferred })
}

impl Gpu {
    /// Has anything gone wrong since the device was opened? Called after work has been submitted; the first fault stays.
    ///
    /// # Errors
    /// [`Error::Device`] if the device was lost, ran out of memory, or refused a command.
    pub fn check(&self) -> Result<()> {
        let fault = self.fault.lock().unwrap_or_else(PoisonError::into_inner).clone();
        fault.map_or(Ok(()), |Fault { what, mend }| {
            Err(Error::Device {
                backend: BACKEND.to_owned(),
                device: self.adapter_info.name.clone(),
                what,
                mend: mend.to_owned(),
            })
        })
    }
}

/// Keeps the first fault of the device, which otherwise would end the process or pass unnoticed.
fn watch(device: &wgpu::Device, fault: &Arc<Mutex<Option<Fault>>>) {
    fn keep(fault: &Mutex<Option<Fault>>, what: String, mend: &'static str) {
        fault.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(Fault { what, mend });
    }
    let seen = Arc::clone(fault);
    device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| match error {
        wgpu::Error::OutOfMemory { source } => keep(&seen, format!("out of memory: {source}"), MEND_MEMORY),
        other => keep(&seen, other.to_string(), MEND_BUG),
    }));
    let seen = Arc::clone(fault);
    // Dropping the device ends in this, too, when nobody asks any more.
    device.set_device_lost_callback(move |_, message| {
        keep(&seen, format!("the device was lost: {message}"), MEND_LOST);
    });
}

/// One for the whole process: NVIDIA's driver finds no adapter any more once some dozens have come and gone. Without flags, what the device counts
/// its own dispatches by is not checked by another pass before each: a sort writes it, and there are no more blocks than there is room for.
static INSTANCE: LazyLock<wgpu::Instance> = LazyLock::new(|| {
    wgpu::Instance::new(wgpu::InstanceDescriptor {
        backends: wgpu::Backends::PRIMARY,
        flags: wgpu::InstanceFlags::empty(),
        ..wgpu::InstanceDescriptor::new_without_display_handle()
    })
});

/// Adapters of all APIs, best first; drivers' order among equals.
fn found() -> Vec<Adapter> {
    let mut adapters = pollster::block_on(INSTANCE.enumerate_adapters(wgpu::Backends::PRIMARY));
    adapters.sort_by_key(|adapter| match adapter.get_info().device_type {
        DeviceType::DiscreteGpu => 0,
        DeviceType::IntegratedGpu => 1,
        DeviceType::VirtualGpu => 2,
        DeviceType::Other => 3,
        DeviceType::Cpu => 4,
    });
    adapters
}

/// Position of the adapter that `choice` names.
fn choose(names: &[&str], choice: Option<&str>) -> Result<usize> {
    if names.is_empty() {
        return Err(Error::Missing {
            kind: "backend",
            name: BACKEND.to_owned(),
            origin: ORIGIN.to_owned(),
            what: "adapter".to_owned(),
            why: "it runs every pass on one".to_owned(),
            mend: "install the driver of a GPU (Vulkan, Metal or Direct3D 12), or a software one: \
                   apt-get install mesa-vulkan-drivers (about 130 MB); or use the backend cpu"
                .to_owned(),
        });
    }
    let Some(choice) = choice else { return Ok(0) };
    if let Some(index) = choice.parse().ok().filter(|index| *index < names.len()) {
        return Ok(index);
    }
    let wanted = choice.to_lowercase();
    let matching = |rule: &dyn Fn(&str) -> bool| -> Vec<usize> {
        (0..names.len()).filter(|i| rule(&names[*i].to_lowercase())).collect()
    };
    match (&matching(&|name| name == wanted)[..], &matching(&|name| name.contains(&wanted))[..]) {
        // Cards of one name are told apart by their numbers.
        ([index, ..], _) | ([], [index]) => Ok(*index),
        _ => Err(Error::Unknown {
            path: "--adapter".to_owned(),
            kind: "adapter",
            name: choice.to_owned(),
            known: names.iter().enumerate().map(|(i, name)| format!("{i}: {name}")).collect(),
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NAMES: [&str; 3] = ["NVIDIA H200", "NVIDIA H200", "llvmpipe (LLVM 15.0.6, 256 bits)"];

    #[test]
    fn an_adapter_is_chosen_by_number_name_or_part_of_its_name() {
        for (choice, index) in [
            (None, 0),
            (Some("1"), 1),
            (Some("nvidia h200"), 0),
            (Some("LLVMpipe"), 2),
            (Some("llvmpipe (LLVM 15.0.6, 256 bits)"), 2),
        ] {
            assert_eq!(choose(&NAMES, choice).unwrap(), index, "{choice:?}");
        }
    }

    #[test]
    fn no_adapter_and_an_unknown_one_are_errors_that_say_what_to_do() {
        let none = choose(&[], None).unwrap_err().to_string();
        assert!(none.contains("apt-get install mesa-vulkan-drivers"), "{none}");
        for choice in ["3", "H200x", "nvidia", ""] {
            let unknown = choose(&NAMES, Some(choice)).unwrap_err().to_string();
            assert!(unknown.contains("2: llvmpipe"), "{unknown}");
        }
    }

    #[test]
    fn a_device_opens_with_all_that_is_offered_and_with_the_least() {
        let all = open(None).unwrap();
        let least = open_with(None, Offer::Least).unwrap();
        println!("{}: {:?}", all.adapter_info.name, all.features);
        assert!(least.features.is_empty());
        assert_eq!(least.limits.max_storage_buffers_per_shader_stage, 8);
        assert!(all.limits.max_storage_buffers_per_shader_stage >= 8);
        assert!(all.features.difference(WELCOME).is_empty());
        all.check().unwrap();
    }

    #[test]
    fn a_refused_command_is_an_error_and_does_not_end_the_process() {
        let gpu = open_with(None, Offer::Least).unwrap();
        let size = gpu.limits.max_buffer_size + 4;
        let _too_large = gpu.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("too large"),
            size,
            usage: wgpu::BufferUsages::STORAGE,
            mapped_at_creation: false,
        });
        let error = gpu.check().unwrap_err().to_string();
        assert!(error.contains("too large") && error.contains(&gpu.adapter_info.name), "{error}");
    }
}
