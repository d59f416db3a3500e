//! numpy arrays as arguments, borrowed where they lie, and as results.

use numpy::{
    Element, PyArrayDescrMethods, PyArrayDyn, PyArrayMethods, PyReadonlyArrayDyn, PyUntypedArray,
    PyUntypedArrayMethods, dtype,
};
use pyo3::prelude::*;

use crate::outcome::InputError;

/// A numpy array that was given for the parameter `name`.
pub(crate) struct Given<'a, 'py> {
    name: &'static str,
    array: &'a Bound<'py, PyUntypedArray>,
}

impl<'a, 'py> Given<'a, 'py> {
    pub(crate) fn new(name: &'static str, given: &'a Bound<'py, PyAny>) -> PyResult<Self> {
        let array = given.cast::<PyUntypedArray>().map_err(|_| {
            let found = given.get_type().name().map_or_else(|_| "something else".to_owned(), |name| name.to_string());
            InputError::new_err(format!("{name}: found {found}, expected a numpy array"))
        })?;
        let given = Self { name, array };
        given.without_a_mask()?;
        Ok(given)
    }

    /// Refuses numpy's masked arrays, of which the values alone would be read, those under the mask, too, or written.
    fn without_a_mask(&self) -> PyResult<()> {
        if !self.array.is_instance(&self.array.py().import("numpy.ma")?.getattr("MaskedArray")?)? {
            return Ok(());
        }
        let advice = match self.name {
            "depth" if self.array.dtype().kind() == b'f' => {
                ", such as its filled(numpy.nan), for which there is fill_missing=True"
            }
            "depth" => ", such as its filled(0), for which there is fill_missing=True",
            name if name.starts_with("out_") => "",
            _ => ", such as its filled(0)",
        };
        Err(self.refusal("a masked array".into(), &format!("one without a mask{advice}")))
    }

    /// Refuses another shape; `names` are those of its axes, `advice` is what is most likely to help.
    pub(crate) fn of_shape(self, expected: &[usize], names: &str, advice: &str) -> PyResult<Self> {
        if self.array.shape() == expected {
            return Ok(self);
        }
        let text = |shape: &[usize]| shape.iter().map(usize::to_string).collect::<Vec<_>>().join(", ");
        Err(self.refusal(
            format!("an array of shape ({})", text(self.array.shape())),
            &format!("({}), which is {names}{advice}", text(expected)),
        ))
    }

    pub(crate) fn shape(&self) -> &[usize] {
        self.array.shape()
    }

    pub(crate) fn is<T: Element>(&self) -> bool {
        self.array.dtype().is_equiv_to(&dtype::<T>(self.array.py()))
    }

    /// The array's type, for messages.
    pub(crate) fn type_name(&self) -> String {
        self.array.dtype().to_string()
    }

    pub(crate) fn refusal(&self, found: String, expected: &str) -> PyErr {
        InputError::new_err(format!("{}: found {found}, expected {expected}", self.name))
    }

    /// Borrows its values; one that is not contiguous is copied.
    pub(crate) fn values<T: Element>(&self) -> PyResult<Values<'py, T>> {
        let py = self.array.py();
        let typed =
            self.array.as_any().cast::<PyArrayDyn<T>>().map_err(|_| {
                self.refusal(format!("an array of {}", self.type_name()), &format!("{}", dtype::<T>(py)))
            })?;
        let lies_right = typed.is_c_contiguous() && typed.is_aligned();
        let typed = if lies_right {
            typed.clone()
        } else {
            typed.call_method1("copy", ("C",))?.cast_into::<PyArrayDyn<T>>()?
        };
        Ok(Values(typed.try_readonly()?))
    }

    /// Writes to it, which must have as many values, be contiguous and writeable.
    pub(crate) fn write<T: Element + Copy>(&self, values: &[T]) -> PyResult<()> {
        let cannot =
            |found: &str| self.refusal(found.to_owned(), "one that can be written to as a whole, C-contiguous");
        let typed = self.array.as_any().cast::<PyArrayDyn<T>>()?;
        let mut borrowed = typed.try_readwrite().map_err(|_| cannot("an array that is read-only, or in use"))?;
        let place = borrowed.as_slice_mut().map_err(|_| cannot("a strided array"))?;
        if place.len() != values.len() {
            let found = format!("an array of {} values", place.len());
            return Err(self.refusal(found, &format!("{} of them", values.len())));
        }
        place.copy_from_slice(values);
        Ok(())
    }
}

/// Values of an array, in C order.
pub(crate) struct Values<'py, T: Element>(PyReadonlyArrayDyn<'py, T>);

impl<T: Element> Values<'_, T> {
    pub(crate) fn as_slice(&self) -> PyResult<&[T]> {
        Ok(self.0.as_slice()?)
    }
}

/// Where a result goes: to an array of Rust's own, or to one that was given for it.
pub(crate) struct Out<'a, 'py>(Option<Given<'a, 'py>>);

impl<'a, 'py> Out<'a, 'py> {
    /// Refuses at once what cannot take `T`s of `shape`.
    pub(crate) fn new<T: Element>(
        name: &'static str,
        given: Option<&'a Bound<'py, PyAny>>,
        shape: [usize; 3],
    ) -> PyResult<Self> {
        let Some(given) = given else { return Ok(Self(None)) };
        let given = Given::new(name, given)?.of_shape(&shape, "(colours, rows, columns)", "")?;
        let py = given.array.py();
        if !given.is::<T>() {
            return Err(given.refusal(format!("an array of {}", given.type_name()), &dtype::<T>(py).to_string()));
        }
        if !given.array.is_c_contiguous() || !given.array.is_aligned() {
            return Err(given.refusal("a strided array".into(), "a C-contiguous one"));
        }
        let writeable = given.array.getattr("flags")?.getattr("writeable")?.is_truthy()?;
        if !writeable {
            return Err(given.refusal("a read-only array".into(), "one that can be written to"));
        }
        Ok(Self(Some(given)))
    }

    /// Puts `values` there; the array that holds them.
    pub(crate) fn put<T: Element + Copy>(
        &self,
        py: Python<'py>,
        values: Vec<T>,
        shape: [usize; 3],
    ) -> PyResult<Bound<'py, PyAny>> {
        match &self.0 {
            None => array(py, values, shape),
            Some(given) => {
                given.write(&values)?;
                Ok(given.array.as_any().clone())
            }
        }
    }
}

/// An array around the memory of `values`.
pub(crate) fn array<'py, T: Element>(
    py: Python<'py>,
    values: Vec<T>,
    shape: [usize; 3],
) -> PyResult<Bound<'py, PyAny>> {
    Ok(numpy::PyArray1::from_vec(py, values).reshape(shape)?.into_any())
}

/// A picture's planes, [3, height, width], as its pixels, [height, width, 3].
pub(crate) fn interleaved(planes: &[f32]) -> Vec<f32> {
    let pixels = planes.len() / 3;
    (0..pixels).flat_map(|pixel| [0, 1, 2].map(|colour| planes[colour * pixels + pixel])).collect()
}
