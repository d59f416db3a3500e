//! Safetensors files whose bytes depend on their content alone, written from where the tensors lie.

use std::collections::BTreeMap;
use std::io::{self, Write};

use safetensors::Dtype;
use serde_json::{Value, json};

/// A tensor on its way into a file.
pub struct Tensor<'a> {
    /// Its key in the file's header.
    pub name: String,
    /// What its values are.
    pub dtype: Dtype,
    /// Its length along each dimension, the outermost first.
    pub shape: Vec<usize>,
    /// Its values, little endian.
    pub bytes: &'a [u8],
}

/// Writes `tensors`, wider values first, with `metadata`, all names of the header in order: where a library's map would
/// bring the metadata in another order each time, the same content is the same bytes.
///
/// # Errors
/// What `out` says.
///
/// # Panics
/// Where a tensor's bytes are more or fewer than its shape's.
pub fn write(out: &mut dyn Write, mut tensors: Vec<Tensor<'_>>, metadata: &BTreeMap<String, String>) -> io::Result<()> {
    // So all are aligned to the size of their values.
    tensors.sort_by(|a, b| b.dtype.cmp(&a.dtype).then(a.name.cmp(&b.name)));
    let strings = metadata.iter().map(|(key, value)| (key.as_str(), Value::from(value.as_str())));
    let mut header = BTreeMap::from([("__metadata__", strings.collect::<BTreeMap<&str, Value>>())]);
    let mut begin = 0;
    for Tensor { name, dtype, shape, bytes } in &tensors {
        assert_eq!(8 * bytes.len(), shape.iter().product::<usize>() * dtype.bitsize(), "`{name}` has its shape's size");
        let end = begin + bytes.len();
        let about = [("data_offsets", json!([begin, end])), ("dtype", json!(dtype)), ("shape", json!(shape))];
        header.insert(name.as_str(), about.into());
        begin = end;
    }
    let mut header = serde_json::to_vec(&header)?;
    // Spaces, so that the data begin aligned.
    header.resize(header.len().next_multiple_of(size_of::<u64>()), b' ');
    out.write_all(&(header.len() as u64).to_le_bytes())?;
    out.write_all(&header)?;
    tensors.iter().try_for_each(|tensor| out.write_all(tensor.bytes))
}

#[cfg(test)]
mod tests {
    use safetensors::SafeTensors;

    use super::*;

    #[test]
    fn a_file_is_read_as_it_was_written_and_does_not_depend_on_the_order() {
        let tensor = |name: &str, dtype, shape: &[usize], bytes| Tensor {
            name: name.to_owned(),
            dtype,
            shape: shape.to_vec(),
            bytes,
        };
        let (half, single) = ([1, 2, 3, 4, 5, 6], [7, 8, 9, 10]);
        let metadata = BTreeMap::from([("kind", "test"), ("a \"key\"", "1\n2")].map(|(k, v)| (k.into(), v.into())));
        let file = |turned: bool| {
            let mut tensors =
                vec![tensor("b", Dtype::F16, &[3], &half[..]), tensor("a", Dtype::F32, &[1, 1], &single[..])];
            if turned {
                tensors.reverse();
            }
            let mut file = Vec::new();
            write(&mut file, tensors, &metadata).unwrap();
            file
        };
        assert_eq!(file(false), file(true));
        let file = file(false);
        let read = SafeTensors::deserialize(&file).unwrap();
        let view = |name: &str| read.tensor(name).map(|view| (view.dtype(), view.shape().to_vec())).unwrap();
        assert_eq!((view("a"), view("b")), ((Dtype::F32, vec![1, 1]), (Dtype::F16, vec![3])));
        assert_eq!((read.tensor("a").unwrap().data(), read.tensor("b").unwrap().data()), (&single[..], &half[..]));
        let (length, header) = SafeTensors::read_metadata(&file).unwrap();
        assert!(length.is_multiple_of(8));
        assert_eq!(header.metadata().clone().unwrap().into_iter().collect::<BTreeMap<_, _>>(), metadata);
    }
}
