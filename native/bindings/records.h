// Arrays of C structs as numpy structured arrays: both sides use the names of the fields, and
// nothing is copied between them.
#ifndef HASELAB_RECORDS_H
#define HASELAB_RECORDS_H

#include <nanobind/nanobind.h>
#include <nanobind/stl/string.h>

#include <cstddef>
#include <initializer_list>
#include <stdexcept>
#include <string>
#include <type_traits>

// Format of a number, or of an array of numbers with one or two dimensions, as numpy writes it.
template <class T> std::string format_of()
{
    using Number = std::remove_all_extents_t<T>;
    static_assert(std::is_arithmetic_v<Number> && std::rank_v<T> <= 2, "a field of numbers");
    std::string shape;
    if constexpr (std::rank_v<T> == 1) {
        shape = "(" + std::to_string(std::extent_v<T>) + ",)";
    } else if constexpr (std::rank_v<T> == 2) {
        shape = "(" + std::to_string(std::extent_v<T, 0>) + "," +
                std::to_string(std::extent_v<T, 1>) + ")";
    }
    const char kind = std::is_floating_point_v<Number> ? 'f' : std::is_signed_v<Number> ? 'i' : 'u';
    return shape + kind + std::to_string(sizeof(Number));
}

struct Field {
    const char *name;
    std::string format;
    size_t offset;
};

#define FIELD(type, name) Field{#name, format_of<decltype(type::name)>(), offsetof(type, name)}

// The numpy dtype of a struct with these fields.
template <class T> nanobind::object dtype_of(std::initializer_list<Field> fields)
{
    nanobind::list names, formats, offsets;
    for (const Field &field : fields) {
        names.append(field.name);
        formats.append(field.format);
        offsets.append(field.offset);
    }
    nanobind::dict layout;
    layout["names"] = names;
    layout["formats"] = formats;
    layout["offsets"] = offsets;
    layout["itemsize"] = sizeof(T);
    return nanobind::module_::import_("numpy").attr("dtype")(layout);
}

// A contiguous array of such structs, for as long as a call lasts; of `const T` to read it only.
template <class T> class Records {
  public:
    explicit Records(nanobind::handle array)
    {
        const int access = std::is_const_v<T> ? PyBUF_SIMPLE : PyBUF_WRITABLE;
        const int flags = PyBUF_C_CONTIGUOUS | PyBUF_FORMAT | access;
        if (PyObject_GetBuffer(array.ptr(), &buffer_, flags) != 0) {
            throw nanobind::python_error();
        }
        // 'T': the format of a struct
        if (buffer_.itemsize != sizeof(T) || !buffer_.format || buffer_.format[0] != 'T') {
            PyBuffer_Release(&buffer_);
            throw std::invalid_argument("the array has the wrong dtype");
        }
    }
    ~Records() { PyBuffer_Release(&buffer_); }
    Records(const Records &) = delete;
    Records &operator=(const Records &) = delete;

    T *data() const { return static_cast<T *>(buffer_.buf); }
    size_t size() const { return static_cast<size_t>(buffer_.len) / sizeof(T); }
    size_t shape(int axis) const
    {
        return axis < buffer_.ndim ? static_cast<size_t>(buffer_.shape[axis]) : 0;
    }

  private:
    Py_buffer buffer_{};
};

#endif
