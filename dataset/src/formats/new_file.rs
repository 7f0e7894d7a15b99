//! HDF5 file being written, with appendable arrays: gzip 4, chunked, booleans encoded as in h5py.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use hdf5::plist::DatasetCreate;
use hdf5::types::VarLenUnicode;
use hdf5::{H5Type, Hyperslab, SliceOrIndex};
use hdf5_sys::h5p::H5Pset_obj_track_times;
use ndarray::ArrayViewD;

use crate::error::{DatasetError, Problem};

pub(crate) const CHUNK_ROWS: usize = 4096;

const CHUNK_NUMBERS: usize = 1 << 20;

/// Same as D4RL.
const GZIP_LEVEL: u8 = 4;

/// File written to `<path>.partial` until [`finish`](Self::finish) renames it.
pub(crate) struct NewFile {
    path: PathBuf,
    partial: PathBuf,
    pub(crate) hdf5: hdf5::File,
}

impl NewFile {
    pub(crate) fn create(path: &Path) -> Result<Self, DatasetError> {
        let io_error = |source: io::Error| DatasetError::new(path, source);
        let mut partial = path.as_os_str().to_owned();
        partial.push(".partial");
        let partial = PathBuf::from(partial);
        if let Some(folder) = path.parent() {
            fs::create_dir_all(folder).map_err(io_error)?;
        }
        if path.is_dir() {
            return Err(io_error(io::ErrorKind::IsADirectory.into()));
        }
        // Leftover of a killed process, or a link through which HDF5 would write into another file.
        match fs::remove_file(&partial) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(io_error(error)),
            _ => fs::File::create_new(&partial).map_err(io_error)?,
        };
        // The earliest format is read by all HDF5 versions, and its groups have no timestamps.
        let mut builder = hdf5::File::with_options();
        let builder = builder.with_fapl(|access| access.libver_earliest());
        let error = |source| DatasetError::new(path, Problem::Write(source));
        let hdf5 = builder.create(&partial).map_err(error)?;
        let path = path.to_owned();
        Ok(Self { path, partial, hdf5 })
    }

    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    pub(crate) fn failed(&self, source: hdf5::Error) -> DatasetError {
        DatasetError::new(&self.partial, Problem::Write(source))
    }

    /// Writes a whole file.
    pub(crate) fn write(
        path: &Path,
        content: impl FnOnce(&Self) -> hdf5::Result<()>,
    ) -> Result<(), DatasetError> {
        let file = Self::create(path)?;
        content(&file).map_err(|source| file.failed(source))?;
        file.finish()
    }

    /// Writes a whole array of rows of `width` numbers or, with `None`, of one number each.
    pub(crate) fn put<T: H5Type>(
        &self,
        name: &'static str,
        width: Option<usize>,
        values: &[T],
    ) -> hdf5::Result<()> {
        Column::create::<T>(self, name, width)?.append(values)
    }

    /// Closes and renames the file; its columns must be dropped before.
    pub(crate) fn finish(self) -> Result<(), DatasetError> {
        drop(self.hdf5);
        fs::File::open(&self.partial)
            .and_then(|file| file.sync_all())
            .and_then(|()| fs::rename(&self.partial, &self.path))
            .map_err(|source| DatasetError::new(self.path, source))
    }
}

/// A text as HDF5 stores it.
pub(crate) fn text(text: &str) -> hdf5::Result<VarLenUnicode> {
    Ok(VarLenUnicode::from_str(text).map_err(|error| error.to_string())?)
}

/// Creation properties without timestamps, so that equal rows give files with equal hashes.
#[allow(unsafe_code)]
fn timeless() -> hdf5::Result<DatasetCreate> {
    let properties = DatasetCreate::try_new()?;
    // SAFETY: the id is that of `properties`, and `sync` keeps other threads out of HDF5.
    match hdf5::sync::sync(|| unsafe { H5Pset_obj_track_times(properties.id(), 0) }) {
        0.. => Ok(properties),
        _ => Err("the HDF5 library keeps the time of arrays".into()),
    }
}

pub(crate) struct Column {
    pub(crate) name: &'static str,
    pub(crate) width: Option<usize>,
    dataset: hdf5::Dataset,
    rows: usize,
}

impl Column {
    pub(crate) fn create<T: H5Type>(
        file: &NewFile,
        name: &'static str,
        width: Option<usize>,
    ) -> hdf5::Result<Self> {
        let builder = file.hdf5.new_dataset::<T>().set_create_plist(&timeless()?);
        let builder = builder.deflate(GZIP_LEVEL);
        let dataset = match width {
            None => builder.chunk((CHUNK_ROWS,)).shape((0..,)),
            Some(width) => {
                let rows = (CHUNK_NUMBERS / width).clamp(1, CHUNK_ROWS);
                builder.chunk((rows, width)).shape((0.., width))
            }
        };
        let dataset = dataset.create(name)?;
        Ok(Self { name, width, dataset, rows: 0 })
    }

    pub(crate) fn append<T: H5Type>(&mut self, values: &[T]) -> hdf5::Result<()> {
        let shape = |rows: usize| -> Vec<usize> { [rows].into_iter().chain(self.width).collect() };
        let new = values.len() / self.width.unwrap_or(1);
        let rows = self.rows + new;
        let view = ArrayViewD::from_shape(shape(new), values)?;
        self.dataset.resize(shape(rows))?;
        let mut slab = vec![SliceOrIndex::from(self.rows..rows)];
        slab.extend(self.width.map(|width| SliceOrIndex::from(0..width)));
        self.dataset.write_slice(view, Hyperslab::from(slab))?;
        self.rows = rows;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_link_is_written_through() {
        let folder = tempfile::tempdir().unwrap();
        let [path, precious] = ["data.hdf5", "precious"].map(|name| folder.path().join(name));
        fs::write(&precious, "precious").unwrap();
        std::os::unix::fs::symlink(&precious, folder.path().join("data.hdf5.partial")).unwrap();
        NewFile::create(&path).unwrap().finish().unwrap();
        assert_eq!(fs::read_to_string(precious).unwrap(), "precious");
        assert!(path.metadata().unwrap().len() > 0 && !path.is_symlink());
    }
}
