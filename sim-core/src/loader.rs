//! Loads material plugins: shared libraries that export `barchan_plugin_v1`.

use crate::{Error, Material, Result};
use barchan_abi as abi;
use std::mem::offset_of;
use std::path::{Path, PathBuf};

/// What a library brought.
pub(crate) struct Loaded {
    /// Its materials, checked.
    pub(crate) materials: Vec<Material>,
    /// What the user should know about it.
    pub(crate) warning: Option<String>,
}

/// No honest table is larger; a greater size means that the pointer leads elsewhere.
const ABSURD: usize = 1 << 16;

/// Why a library or table is refused, and what would mend it.
pub(crate) struct Refusal {
    pub(crate) what: String,
    pub(crate) mend: String,
}

impl Refusal {
    pub(crate) fn new(what: impl Into<String>, mend: impl Into<String>) -> Self {
        Self { what: what.into(), mend: mend.into() }
    }
    /// The error it becomes for a library.
    pub(crate) fn of(self, library: &Path) -> Error {
        Error::Plugin { library: library.to_owned(), what: self.what, mend: self.mend }
    }
}

/// Opens a library, gets its table, and reads all its materials. It is never unloaded, because function pointers and
/// strings of its materials stay in use.
pub(crate) fn load(library: &Path) -> Result<Loaded> {
    let path = library.canonicalize().map_err(|e| {
        Refusal::new(format!("cannot be opened: {e}"), "give the path of a built library (.so, .dylib or .dll)")
            .of(library)
    })?;
    load_absolute(&path).map_err(|refusal| refusal.of(&path))
}

fn load_absolute(path: &PathBuf) -> Result<Loaded, Refusal> {
    // SAFETY: runs the library's constructors; the user named this very file, which is the ABI's condition.
    let library = unsafe { libloading::Library::new(path) }
        .map_err(|e| Refusal::new(with_sources(&e), "check that it is a shared library for this machine"))?;
    let library = std::mem::ManuallyDrop::new(library);
    // SAFETY: a symbol of this name has this type by the ABI.
    let entry = unsafe {
        library.get::<unsafe extern "C" fn() -> *const abi::BarchanPlugin>(entry_symbol(abi::BARCHAN_ABI_MAJOR))
    }
    .map_err(|_| no_entry(&library))?;
    // SAFETY: the ABI's entry function takes nothing and returns a static table.
    let table = unsafe { entry() };
    // SAFETY: a non-null result is a table that starts with its size, by the ABI.
    let plugin: abi::BarchanPlugin = unsafe { read_prefix(table, "BarchanPlugin", size_of::<abi::BarchanPlugin>()) }?;
    check_major(plugin.abi_major, plugin.abi_minor, "the library")?;
    let count = plugin.n_materials;
    if count == 0 || count > ABSURD || plugin.materials.is_null() || !plugin.materials.is_aligned() {
        return Err(Refusal::new(
            format!("its table lists {count} materials at {:p}", plugin.materials),
            "fill `materials` and `n_materials` with at least one material",
        ));
    }
    let materials = (0..count)
        .map(|i| {
            // SAFETY: `materials` has `n_materials` entries by the ABI; null and misaligned ones are refused above.
            let material = unsafe { plugin.materials.add(i).read() };
            // SAFETY: the entry is null or a static table by the ABI.
            unsafe { Material::read_table(material, &path.display().to_string()) }
                .map_err(|r| Refusal::new(format!("material {i} of {count}: {}", r.what), r.mend))
        })
        .collect::<Result<Vec<_>, _>>()?;
    let warning = (plugin.flags & abi::BARCHAN_PLUGIN_PANIC_ABORT != 0).then(|| {
        format!(
            "plugin {} was built with panic = \"abort\": a panic in it ends this process without saving; build it with panic = \"unwind\"",
            path.display()
        )
    });
    Ok(Loaded { materials, warning })
}

fn entry_symbol(major: u32) -> String {
    format!("barchan_plugin_v{major}")
}

/// Says whether the library is of another major version or no plugin at all.
fn no_entry(library: &libloading::Library) -> Refusal {
    let wanted = entry_symbol(abi::BARCHAN_ABI_MAJOR);
    let other = (0..32).find(|&major| {
        // SAFETY: the symbol is only looked up, never called.
        unsafe { library.get::<unsafe extern "C" fn()>(entry_symbol(major)) }.is_ok()
    });
    match other {
        Some(major) => wrong_major(major, None, "the library"),
        None => Refusal::new(
            format!("exports no symbol {wanted}, so it is no Barchan plugin"),
            format!(
                "export `const BarchanPlugin *{wanted}(void)`; in Rust: crate-type cdylib and the kit's export macro"
            ),
        ),
    }
}

/// Refuses another major version, naming both.
pub(crate) fn check_major(major: u32, minor: u32, whose: &str) -> Result<(), Refusal> {
    if major == abi::BARCHAN_ABI_MAJOR { Ok(()) } else { Err(wrong_major(major, Some(minor), whose)) }
}

fn wrong_major(major: u32, minor: Option<u32>, whose: &str) -> Refusal {
    let theirs = minor.map_or_else(|| format!("{major}"), |minor| format!("{major}.{minor}"));
    Refusal::new(
        format!(
            "{whose} was built for plugin ABI {theirs}, this program has {}.{}",
            abi::BARCHAN_ABI_MAJOR,
            abi::BARCHAN_ABI_MINOR
        ),
        format!("rebuild it against major version {}", abi::BARCHAN_ABI_MAJOR),
    )
}

/// Copies a struct by the prefix rule: as many bytes as both sides know, the rest zero.
///
/// # Safety
/// `from` is null or points to a struct of the ABI that starts with its size in bytes. `T` may be all zero bytes.
pub(crate) unsafe fn read_prefix<T>(from: *const T, name: &str, least: usize) -> Result<T, Refusal> {
    if from.is_null() || !from.is_aligned() {
        return Err(Refusal::new(format!("its {name} pointer is {from:p}"), "return the address of a static table"));
    }
    // SAFETY: every struct of the ABI starts with a usize.
    let size = unsafe { from.cast::<usize>().read() };
    if size < least || size > ABSURD {
        return Err(Refusal::new(
            format!("its {name} has struct_size {size}; version 1 has at least {least} bytes"),
            format!("set struct_size to sizeof({name})"),
        ));
    }
    // SAFETY: the struct has `size` bytes.
    Ok(unsafe { copy_prefix(from.cast(), size) })
}

/// Copies at most `size` bytes into a zeroed `T`.
///
/// # Safety
/// `size` bytes can be read at `from`. `T` may be all zero bytes.
unsafe fn copy_prefix<T>(from: *const u8, size: usize) -> T {
    let mut to = std::mem::MaybeUninit::<T>::zeroed();
    // SAFETY: at most size_of::<T>() bytes are written, `size` bytes are readable, and all-zero is a valid T.
    unsafe {
        std::ptr::copy_nonoverlapping(from, to.as_mut_ptr().cast::<u8>(), size.min(size_of::<T>()));
        to.assume_init()
    }
}

/// Copies an array whose entries are `step` bytes apart, entry by entry by the prefix rule.
///
/// # Safety
/// `from` is null or points to `count` entries, `step` bytes apart. `T` may be all zero bytes.
pub(crate) unsafe fn read_array<T>(from: *const T, count: usize, step: usize, name: &str) -> Result<Vec<T>, Refusal> {
    if count == 0 {
        return Ok(Vec::new());
    }
    if from.is_null() || !from.is_aligned() || count > ABSURD || step < size_of::<T>() || step > ABSURD {
        return Err(Refusal::new(
            format!("lists {count} {name} entries of {step} bytes at {from:p}"),
            format!("set the pointer, the count, and the entries' size to sizeof({name})"),
        ));
    }
    // SAFETY: entry i starts i * step bytes on and has `step` bytes.
    Ok((0..count).map(|i| unsafe { copy_prefix(from.cast::<u8>().add(i * step), step) }).collect())
}

/// Copies a string out of a library.
///
/// # Safety
/// The pointer is null or `len` bytes can be read there.
pub(crate) unsafe fn read_text(text: abi::BarchanStr, field: &str) -> Result<String, Refusal> {
    const LONGEST: usize = 1 << 22;
    if text.len == 0 {
        return Ok(String::new());
    }
    if text.ptr.is_null() || text.len > LONGEST {
        return Err(Refusal::new(
            format!("its {field} has {} bytes at {:p}", text.len, text.ptr),
            "point it to static UTF-8 text and set its length in bytes",
        ));
    }
    // SAFETY: not null, and `len` bytes by the ABI.
    let bytes = unsafe { std::slice::from_raw_parts(text.ptr, text.len) };
    String::from_utf8(bytes.to_vec()).map_err(|e| {
        Refusal::new(
            format!("its {field} is not UTF-8 (byte {} of {})", e.utf8_error().valid_up_to(), text.len),
            "save the source as UTF-8 and give the length in bytes",
        )
    })
}

/// The least size of a material's table: up to and with its one required slot.
pub(crate) const LEAST_MATERIAL: usize =
    offset_of!(abi::BarchanMaterial, update_f32) + size_of::<abi::BarchanUpdateF32>();

/// An error's text followed by its causes': libloading keeps the system's reason in the source.
fn with_sources(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut source = error.source();
    while let Some(inner) = source {
        text = format!("{text}: {inner}");
        source = inner.source();
    }
    text
}
