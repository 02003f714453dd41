/* The compiled kernel: the functions of `exchange`, under the same names and contracts.
 *
 * Rules: the limited API of Python 3.11 and the buffer protocol, nothing else, so one build serves
 * all later versions. Another process may write anything into shared memory at any time: each word
 * is read once, and checked before it is used as a position. Every buffer is checked for the size
 * of its elements, its alignment and its length before it is used. No function keeps state of its
 * own; a `RowStep` holds buffers for its whole life, so no other thread can take them away. No
 * `Py_RETURN_NONE` and its like: in headers of Python 3.12 they count on immortal objects, and
 * Python 3.11, which may load the build, ends with "deallocating True or False".
 */

#define PY_SSIZE_T_CLEAN
#ifndef Py_GIL_DISABLED
#define Py_LIMITED_API 0x030B0000
#endif
#include <Python.h>

#include <limits.h>
#include <stdint.h>
#include <string.h>
#include <time.h>

/* ---- words shared with the twins in `exchange` ---------------------------------------- */

enum {
    LINE = 8,
    /* Words of a ring. */
    REQUESTS_SENT = 0 * LINE,
    WORKER_ASLEEP = 1 * LINE,
    FRAMES_TO_WORKER = 2 * LINE,
    FRAMES_TO_TRAINER = 3 * LINE,
    CURRENT = 4 * LINE,
    CURRENT_SINCE_NS = 4 * LINE + 1,
    /* The trainer's own counts, and the worker's. */
    SENT = 0,
    SEEN = 1,
    TAKEN = 0,
    REPORTED = 1,
    FRAMES_SEEN = 2,
    SETTLED = 3,
    CAREFUL = 4,
    /* Entries. */
    OP_BITS = 8,
    OP_MASK = 0xff,
    NUMBER_SHIFT = 28,
    STEP = 1,
    BUSY = 1,
    /* The armed word. */
    ARMED = 0,
    AT_LAST = 2,
    GOAL_SHIFT = 2,
    /* Flags of a row, and marks of infos. */
    TERMINATED = 0,
    TRUNCATED = 1,
    IS_RESET = 2,
    OVER = 3,
    NO_INFO = 0,
    PICKLED = 255,
};
#define SLOT_MASK ((int64_t)0xfffff)
#define GOAL_MASK (((int64_t)1 << 53) - 1)

static inline int64_t
load(const int64_t *word)
{
    return __atomic_load_n(word, __ATOMIC_ACQUIRE);
}

static inline void
publish(int64_t *word, int64_t value)
{
    __atomic_store_n(word, value, __ATOMIC_RELEASE);
}

static inline int64_t
peek(const int64_t *word)
{
    return __atomic_load_n(word, __ATOMIC_RELAXED);
}

static inline void
put(int64_t *word, int64_t value)
{
    __atomic_store_n(word, value, __ATOMIC_RELAXED);
}

static inline void
fence(void)
{
    __atomic_thread_fence(__ATOMIC_SEQ_CST);
}

static int64_t
now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}

/* ---- buffers ------------------------------------------------------------------------------ */

static const char *
kind_of(const Py_buffer *view)
{
    const char *format = view->format ? view->format : "B";
    return *format == '@' || *format == '=' ? format + 1 : format;
}

/* Get a one-dimensional buffer of `size` bytes for each element and one of the format's `kinds`;
 * `strided` ones may have gaps between their elements. */
static int
get_vector(PyObject *from, Py_buffer *view, const char *kinds, Py_ssize_t size, int writable,
           int strided, const char *name)
{
    int flags = PyBUF_FORMAT | (strided ? PyBUF_STRIDES : PyBUF_ND | PyBUF_C_CONTIGUOUS);
    if (PyObject_GetBuffer(from, view, flags | (writable ? PyBUF_WRITABLE : 0)) < 0) {
        view->obj = NULL;
        return -1;
    }
    const char *kind = kind_of(view);
    if (view->ndim != 1 || view->itemsize != size || kind[0] == 0 || kind[1] != 0 ||
        strchr(kinds, kind[0]) == NULL || (uintptr_t)view->buf % (size_t)size != 0 ||
        (strided && view->strides[0] % size != 0)) {
        PyErr_Format(PyExc_TypeError, "%s: unexpected buffer with %d axes of format '%s'", name,
                     view->ndim, kind);
        PyBuffer_Release(view);
        view->obj = NULL;
        return -1;
    }
    return 0;
}

static int
get_words(PyObject *from, Py_buffer *view, int writable, const char *name)
{
    return get_vector(from, view, "qlnL", 8, writable, 0, name);
}

static inline Py_ssize_t
length(const Py_buffer *view)
{
    return view->shape[0];
}

static inline int64_t *
words_of(const Py_buffer *view)
{
    return (int64_t *)view->buf;
}

static void
release_all(Py_buffer *views, int count)
{
    for (int k = 0; k < count; k++)
        if (views[k].obj != NULL)
            PyBuffer_Release(&views[k]);
}

/* A new reference, which stays valid if the list is changed meanwhile. */
static PyObject *
item_of(PyObject *list, Py_ssize_t position)
{
#ifdef Py_GIL_DISABLED
    return PyList_GetItemRef(list, position);
#else
    PyObject *item = PyList_GetItem(list, position);
    Py_XINCREF(item);
    return item;
#endif
}

static int
add_to_count(PyObject *list, Py_ssize_t position, Py_ssize_t amount)
{
    PyObject *before = item_of(list, position);
    if (before == NULL)
        return -1;
    Py_ssize_t count = PyLong_AsSsize_t(before);
    Py_DECREF(before);
    if (count == -1 && PyErr_Occurred())
        return -1;
    PyObject *after = PyLong_FromSsize_t(count + amount);
    return after == NULL ? -1 : PyList_SetItem(list, position, after);
}

/* ---- what the module keeps: three names of NumPy's ------------------------------------------ */

typedef struct {
    PyObject *empty, *intp, *ndarray;
} State;

static inline State *
state_of(PyObject *module)
{
    return (State *)PyModule_GetState(module);
}

/* ---- rings of the trainer -------------------------------------------------------------------- */

typedef struct {
    Py_buffer words, entries, own;
} Ring;

enum { OF_WORDS, OF_REQUESTS, OF_REPORTS, OF_OWN, RING_FIELDS = 5 };

static void
release_ring(Ring *ring)
{
    release_all(&ring->words, 1);
    release_all(&ring->entries, 1);
    release_all(&ring->own, 1);
}

/* Get the buffers of an `exchange.Ring`, whose entries are in the field `entries`. */
static int
get_ring(PyObject *from, int entries, Ring *ring)
{
    ring->words.obj = ring->entries.obj = ring->own.obj = NULL;
    if (!PyTuple_Check(from) || PyTuple_Size(from) < RING_FIELDS) {
        PyErr_SetString(PyExc_TypeError, "expected a Ring");
        return -1;
    }
    if (get_words(PyTuple_GetItem(from, OF_WORDS), &ring->words, 1, "words") < 0 ||
        get_words(PyTuple_GetItem(from, entries), &ring->entries, 1, "entries") < 0 ||
        get_words(PyTuple_GetItem(from, OF_OWN), &ring->own, 1, "own") < 0) {
        release_ring(ring);
        return -1;
    }
    Py_ssize_t capacity = length(&ring->entries);
    if (length(&ring->words) <= FRAMES_TO_TRAINER || length(&ring->own) <= SEEN || capacity < 1 ||
        (capacity & (capacity - 1)) != 0) {
        PyErr_SetString(PyExc_ValueError, "a ring has words, own counts, and 2**n entries");
        release_ring(ring);
        return -1;
    }
    return 0;
}

/* ---- submit ----------------------------------------------------------------------------------- */

enum { SLOTS, RESETS, ENTRY, STATE, SENT_NS, HOST_OF, SUBMIT_VIEWS };

/* Publish the entries of `slots`, all of one host. Return its ring if the entries fit there. */
static int
publish_run(const Py_buffer *views, Py_ssize_t start, Py_ssize_t end, PyObject *ring_object)
{
    Ring ring;
    if (get_ring(ring_object, OF_REQUESTS, &ring) < 0)
        return -1;
    const int64_t *slots = words_of(&views[SLOTS]), *entry = words_of(&views[ENTRY]);
    int64_t *entries = words_of(&ring.entries), *own = words_of(&ring.own);
    uint64_t capacity = (uint64_t)length(&ring.entries), sent = (uint64_t)own[SENT];
    if ((uint64_t)(end - start) > capacity) {
        PyErr_SetString(PyExc_ValueError, "more requests than a ring has entries");
        release_ring(&ring);
        return -1;
    }
    for (Py_ssize_t k = start; k < end; k++, sent++)
        put(&entries[sent & (capacity - 1)], entry[slots[k]]);
    own[SENT] = (int64_t)sent;
    publish(words_of(&ring.words) + REQUESTS_SENT, (int64_t)sent);
    release_ring(&ring);
    return 0;
}

static int
is_asleep(PyObject *ring_object)
{
    Ring ring;
    if (get_ring(ring_object, OF_REQUESTS, &ring) < 0)
        return -1;
    int asleep = load(words_of(&ring.words) + WORKER_ASLEEP) != 0;
    release_ring(&ring);
    return asleep;
}

/* Check all of it first: each slot has its values and a host with a ring. */
static int
check_submit(const Py_buffer *views, PyObject *in_flight, PyObject *rings)
{
    Py_ssize_t count = length(&views[SLOTS]), size = length(&views[ENTRY]);
    if (length(&views[RESETS]) != count || length(&views[STATE]) < size ||
        length(&views[SENT_NS]) < size || length(&views[HOST_OF]) < size) {
        PyErr_SetString(PyExc_ValueError, "columns of different lengths");
        return -1;
    }
    Py_ssize_t hosts = PyList_Size(rings);
    if (PyList_Size(in_flight) < hosts)
        hosts = PyList_Size(in_flight);
    for (Py_ssize_t k = 0; k < count; k++) {
        int64_t slot = words_of(&views[SLOTS])[k];
        if (slot < 0 || slot >= size) {
            PyErr_Format(PyExc_IndexError, "slot %lld of %zd", (long long)slot, size);
            return -1;
        }
        int64_t host = words_of(&views[HOST_OF])[slot];
        if (host < 0 || host >= hosts) {
            PyErr_Format(PyExc_IndexError, "host %lld of %zd", (long long)host, hosts);
            return -1;
        }
        PyObject *ring = item_of(rings, host);
        Py_XDECREF(ring);
        if (ring == Py_None) {
            PyErr_Format(PyExc_AssertionError, "host %lld has no ring", (long long)host);
            return -1;
        }
    }
    return 0;
}

static PyObject *
submit_views(const Py_buffer *views, int64_t now, PyObject *in_flight, PyObject *rings)
{
    if (check_submit(views, in_flight, rings) < 0)
        return NULL;
    Py_ssize_t count = length(&views[SLOTS]);
    const int64_t *slots = words_of(&views[SLOTS]), *host_of = words_of(&views[HOST_OF]);
    const uint8_t *resets = views[RESETS].buf;
    for (Py_ssize_t k = 0; k < count; k++) {
        int64_t slot = slots[k];
        uint64_t entry = (uint64_t)words_of(&views[ENTRY])[slot] & ~(uint64_t)OP_MASK;
        entry += ((uint64_t)1 << NUMBER_SHIFT) + STEP + (resets[k] != 0); /* RESET == STEP + 1 */
        words_of(&views[ENTRY])[slot] = (int64_t)entry;
        ((int8_t *)views[STATE].buf)[slot] = BUSY;
        words_of(&views[SENT_NS])[slot] = now;
    }
    PyObject *asleep = PyList_New(0);
    if (asleep == NULL)
        return NULL;
    for (int turn = 0; turn < 2; turn++) { /* Publish to all, then look who sleeps. */
        for (Py_ssize_t start = 0, end; start < count; start = end) {
            int64_t host = host_of[slots[start]];
            for (end = start + 1; end < count && host_of[slots[end]] == host; end++)
                ;
            PyObject *ring = item_of(rings, host);
            if (ring == NULL)
                goto failed;
            int found = turn ? is_asleep(ring) : publish_run(views, start, end, ring);
            if (found > 0)
                found = PyList_Append(asleep, ring);
            Py_DECREF(ring);
            if (found < 0 || (!turn && add_to_count(in_flight, host, end - start) < 0))
                goto failed;
        }
        fence();
    }
    return asleep;
failed:
    Py_DECREF(asleep);
    return NULL;
}

PyDoc_STRVAR(submit_doc, "See `exchange.submit`.");

static PyObject *
kernel_submit(PyObject *module, PyObject *args)
{
    (void)module;
    PyObject *from[SUBMIT_VIEWS], *in_flight, *rings, *fence_object;
    long long now;
    if (!PyArg_ParseTuple(args, "OOLOOOOO!O!O:submit", &from[SLOTS], &from[RESETS], &now,
                          &from[ENTRY], &from[STATE], &from[SENT_NS], &from[HOST_OF], &PyList_Type,
                          &in_flight, &PyList_Type, &rings, &fence_object))
        return NULL;
    Py_buffer views[SUBMIT_VIEWS];
    for (int k = 0; k < SUBMIT_VIEWS; k++)
        views[k].obj = NULL;
    PyObject *found = NULL;
    if (get_words(from[SLOTS], &views[SLOTS], 0, "slots") == 0 &&
        get_vector(from[RESETS], &views[RESETS], "?", 1, 0, 0, "resets") == 0 &&
        get_words(from[ENTRY], &views[ENTRY], 1, "entry") == 0 &&
        get_vector(from[STATE], &views[STATE], "b", 1, 1, 0, "state") == 0 &&
        get_words(from[SENT_NS], &views[SENT_NS], 1, "sent_ns") == 0 &&
        get_words(from[HOST_OF], &views[HOST_OF], 0, "host_of") == 0)
        found = submit_views(views, now, in_flight, rings);
    release_all(views, SUBMIT_VIEWS);
    return found;
}

/* ---- complete --------------------------------------------------------------------------------- */

/* An empty array of `count` positions, with its buffer. */
static PyObject *
new_positions(const State *state, Py_ssize_t count, Py_buffer *view)
{
    PyObject *array = PyObject_CallFunction(state->empty, "nO", count, state->intp);
    if (array != NULL && get_words(array, view, 1, "positions") < 0)
        Py_CLEAR(array);
    return array;
}

/* Read the reports of one worker into `slots`. Return their number, -1 for an error, -2 if the
 * general path must read them. */
static Py_ssize_t
read_reports(PyObject *ring_object, int64_t before, int64_t count, const Py_buffer *entry,
             int64_t *slots, Py_ssize_t room)
{
    if (ring_object == Py_None)
        return -2;
    Ring ring;
    if (get_ring(ring_object, OF_REPORTS, &ring) < 0)
        return -1;
    uint64_t capacity = (uint64_t)length(&ring.entries);
    uint64_t num_read = (uint64_t)count - (uint64_t)before;
    Py_ssize_t found = (Py_ssize_t)num_read;
    if (load(words_of(&ring.words) + FRAMES_TO_TRAINER) > words_of(&ring.own)[SEEN] ||
        num_read > capacity || num_read > (uint64_t)room)
        found = -2;
    for (Py_ssize_t k = 0; k < found; k++) {
        int64_t report = peek(words_of(&ring.entries) + ((uint64_t)(before + k) & (capacity - 1)));
        int64_t slot = (report >> OP_BITS) & SLOT_MASK;
        if (slot >= length(entry) || words_of(entry)[slot] != report)
            found = -2;
        else
            slots[k] = slot;
    }
    release_ring(&ring);
    return found;
}

static PyObject *
complete_views(const State *state, const Py_buffer *counters, const Py_buffer *read,
               const Py_buffer *entry, PyObject *in_flight, PyObject *rings)
{
    Py_ssize_t hosts = length(counters), step = counters->strides[0] / 8;
    if (length(read) != hosts + 1 || PyList_Size(rings) < hosts ||
        PyList_Size(in_flight) < hosts) {
        PyErr_SetString(PyExc_ValueError, "columns of different lengths");
        return NULL;
    }
    int64_t *known = words_of(read);
    /* Each counter is read once: what comes later waits for the next call. */
    int64_t *counts = PyMem_Malloc((size_t)(hosts ? hosts : 1) * sizeof(int64_t));
    if (counts == NULL)
        return PyErr_NoMemory();
    uint64_t total = 0;
    for (Py_ssize_t host = 0; host < hosts; host++) {
        counts[host] = load(words_of(counters) + host * step);
        uint64_t num_read = (uint64_t)counts[host] - (uint64_t)known[host];
        total += num_read <= (uint64_t)length(entry) ? num_read : (uint64_t)length(entry) + 1;
    }
    Py_buffer into;
    PyObject *slots = NULL;
    if (total > (uint64_t)length(entry)) { /* Each env has one request in flight at most. */
        slots = Py_None;
        Py_INCREF(slots);
        goto done;
    }
    slots = new_positions(state, (Py_ssize_t)total, &into);
    if (slots == NULL)
        goto done;
    Py_ssize_t filled = 0, found = 0;
    for (Py_ssize_t host = 0; found >= 0 && host < hosts; host++) {
        if (counts[host] == known[host])
            continue;
        PyObject *ring = item_of(rings, host);
        if (ring == NULL) {
            found = -1;
            break;
        }
        found = read_reports(ring, known[host], counts[host], entry, words_of(&into) + filled,
                             (Py_ssize_t)total - filled);
        Py_DECREF(ring);
        filled += found;
    }
    PyBuffer_Release(&into);
    for (Py_ssize_t host = 0; found >= 0 && host < hosts; host++) {
        int64_t num_read = counts[host] - known[host];
        if (num_read == 0)
            continue;
        known[host] = counts[host];
        known[hosts] += num_read;
        found = add_to_count(in_flight, host, -(Py_ssize_t)num_read);
    }
    if (found < 0) {
        Py_CLEAR(slots);
        if (found == -2) {
            slots = Py_None;
            Py_INCREF(slots);
        }
    }
done:
    PyMem_Free(counts);
    return slots;
}

PyDoc_STRVAR(complete_doc, "See `exchange.complete`.");

static PyObject *
kernel_complete(PyObject *module, PyObject *args)
{
    PyObject *from[3], *in_flight, *rings, *fence_object;
    if (!PyArg_ParseTuple(args, "OOOO!O!O:complete", &from[0], &from[1], &from[2], &PyList_Type,
                          &in_flight, &PyList_Type, &rings, &fence_object))
        return NULL;
    Py_buffer views[3] = {{0}, {0}, {0}};
    PyObject *found = NULL;
    if (get_vector(from[0], &views[0], "qlnL", 8, 0, 1, "counters") == 0 &&
        get_words(from[1], &views[1], 1, "read") == 0 &&
        get_words(from[2], &views[2], 0, "entry") == 0)
        found = complete_views(state_of(module), &views[0], &views[1], &views[2], in_flight, rings);
    release_all(views, 3);
    return found;
}

/* ---- gather ------------------------------------------------------------------------------------- */

/* Copy rows of a column: `count` from `start`, or those that `rows` names. */
static int
copy_rows(const Py_buffer *column, const Py_buffer *into, const int64_t *rows, Py_ssize_t start,
          Py_ssize_t count)
{
    Py_ssize_t size = column->itemsize, stride = column->strides[0];
    for (int axis = column->ndim - 1; axis > 0; axis--) {
        if (column->shape[axis] > 1 && column->strides[axis] != size) {
            PyErr_SetString(PyExc_ValueError, "the elements of a row must be contiguous");
            return -1;
        }
        size *= column->shape[axis];
    }
    if (into->len != count * size) {
        PyErr_SetString(PyExc_ValueError, "a copy of another size than its rows");
        return -1;
    }
    const char *source = column->buf;
    char *target = into->buf;
    if (rows == NULL && stride == size)
        memcpy(target, source + start * stride, (size_t)(count * size));
    else
        for (Py_ssize_t k = 0; k < count; k++)
            memcpy(target + k * size, source + (rows ? rows[k] : start + k) * stride, (size_t)size);
    return 0;
}

static PyObject *
gather_column(PyObject *column, PyObject *empty, const int64_t *rows, Py_ssize_t start,
              Py_ssize_t count)
{
    Py_buffer from = {0}, into = {0};
    if (PyObject_GetBuffer(column, &from, PyBUF_STRIDES | PyBUF_FORMAT) < 0)
        return NULL;
    PyObject *shape = NULL, *dtype = NULL, *copy = NULL;
    if (from.ndim < 1 || strchr(kind_of(&from), 'O') != NULL) {
        PyErr_SetString(PyExc_TypeError, "expected a column of numbers");
        goto done;
    }
    for (Py_ssize_t k = 0; rows && k < count; k++)
        if (rows[k] < 0 || rows[k] >= from.shape[0]) {
            PyErr_Format(PyExc_IndexError, "row %lld of %zd", (long long)rows[k], from.shape[0]);
            goto done;
        }
    if (!rows && start + count > from.shape[0])
        count = from.shape[0] > start ? from.shape[0] - start : 0;
    shape = PyTuple_New(from.ndim);
    for (int axis = 0; shape != NULL && axis < from.ndim; axis++) {
        PyObject *extent = PyLong_FromSsize_t(axis ? from.shape[axis] : count);
        if (extent == NULL || PyTuple_SetItem(shape, axis, extent) < 0)
            Py_CLEAR(shape);
    }
    dtype = shape ? PyObject_GetAttrString(column, "dtype") : NULL;
    copy = dtype ? PyObject_CallFunctionObjArgs(empty, shape, dtype, NULL) : NULL;
    if (copy != NULL &&
        (PyObject_GetBuffer(copy, &into, PyBUF_WRITABLE | PyBUF_C_CONTIGUOUS) < 0 ||
         copy_rows(&from, &into, rows, start, count) < 0))
        Py_CLEAR(copy);
    if (into.obj != NULL)
        PyBuffer_Release(&into);
done:
    Py_XDECREF(shape);
    Py_XDECREF(dtype);
    PyBuffer_Release(&from);
    return copy;
}

PyDoc_STRVAR(gather_doc, "See `exchange.gather`.");

static PyObject *
kernel_gather(PyObject *module, PyObject *args)
{
    PyObject *columns, *rows;
    if (!PyArg_ParseTuple(args, "OO:gather", &columns, &rows))
        return NULL;
    Py_ssize_t start = 0, stop = 0, step = 1, count = 0;
    Py_buffer positions = {0};
    const int64_t *chosen = NULL;
    if (PySlice_Check(rows)) {
        if (PySlice_Unpack(rows, &start, &stop, &step) < 0)
            return NULL;
        if (start < 0 || step != 1) {
            PyErr_SetString(PyExc_ValueError, "a slice of rows has a start and no step");
            return NULL;
        }
        count = stop > start ? stop - start : 0;
    }
    else {
        if (get_words(rows, &positions, 0, "rows") < 0)
            return NULL;
        chosen = words_of(&positions);
        count = length(&positions);
    }
    PyObject *all = PySequence_List(columns), *found = all == NULL ? NULL : PyList_New(0);
    for (Py_ssize_t k = 0; found != NULL && k < PyList_Size(all); k++) {
        PyObject *copy = gather_column(PyList_GetItem(all, k), state_of(module)->empty,
                                       chosen, start, count);
        if (copy == NULL || PyList_Append(found, copy) < 0)
            Py_CLEAR(found);
        Py_XDECREF(copy);
    }
    Py_XDECREF(all);
    if (positions.obj != NULL)
        PyBuffer_Release(&positions);
    return found;
}

/* ---- the bell ------------------------------------------------------------------------------------ */

/* Wide, so that impossible counters do not wrap around: the twin's integers do not, either. */
static __int128
sum_of_counters(const Py_buffer *words)
{
    __int128 sum = 0;
    for (Py_ssize_t k = LINE; k < length(words); k += LINE)
        sum += load(words_of(words) + k);
    return sum;
}

static inline int64_t
goal_of(int64_t armed)
{
    return (armed >> GOAL_SHIFT) & GOAL_MASK;
}

PyDoc_STRVAR(arm_doc, "See `exchange.arm`.");

static PyObject *
kernel_arm(PyObject *module, PyObject *args)
{
    (void)module;
    PyObject *from, *fence_object;
    long long armed;
    Py_buffer words;
    if (!PyArg_ParseTuple(args, "OLO:arm", &from, &armed, &fence_object))
        return NULL;
    if (get_words(from, &words, 1, "words") < 0)
        return NULL;
    if (length(&words) <= ARMED) {
        PyBuffer_Release(&words);
        PyErr_SetString(PyExc_ValueError, "a bell has words");
        return NULL;
    }
    if (peek(words_of(&words) + ARMED) != armed) {
        put(words_of(&words) + ARMED, armed);
        fence();
    }
    int reached = sum_of_counters(&words) >= goal_of(armed);
    PyBuffer_Release(&words);
    return PyBool_FromLong(reached);
}

/* Whether this worker must ring the trainer now; see `exchange.is_due`. It looks after each report,
 * and, `at_last`, when it has run out of work. */
static int
bell_is_due(const Py_buffer *words, int64_t *own, int at_last)
{
    fence();
    int64_t armed = load(words_of(words) + ARMED);
    if (armed == own[SETTLED] || (armed & AT_LAST && !at_last))
        return 0;
    if (armed && sum_of_counters(words) < goal_of(armed))
        return 0;
    own[SETTLED] = armed;
    return armed != 0;
}

PyDoc_STRVAR(is_due_doc, "See `exchange.is_due`.");

static PyObject *
kernel_is_due(PyObject *module, PyObject *args)
{
    (void)module;
    PyObject *from[2], *fence_object;
    if (!PyArg_ParseTuple(args, "OOO:is_due", &from[0], &from[1], &fence_object))
        return NULL;
    Py_buffer views[2] = {{0}, {0}};
    PyObject *found = NULL;
    if (get_words(from[0], &views[0], 0, "bell") == 0 &&
        get_words(from[1], &views[1], 1, "own") == 0) {
        if (length(&views[0]) <= ARMED || length(&views[1]) <= CAREFUL)
            PyErr_SetString(PyExc_ValueError, "a bell or a worker's counts are too short");
        else
            found = PyBool_FromLong(bell_is_due(&views[0], words_of(&views[1]), 1));
    }
    release_all(views, 2);
    return found;
}

/* ---- the worker's loop ---------------------------------------------------------------------------- */

enum { LOOP_WORDS, LOOP_REQUESTS, LOOP_REPORTS, LOOP_OWN, LOOP_BELL, LOOP_VIEWS };

typedef struct {
    Py_buffer views[LOOP_VIEWS];
    Py_ssize_t counter; /* Position of the worker's counter in the bell. */
    PyObject *steps, *execute, *finish, *ring, *receive;
    long long first_slot;
} Loop;

static int
called(PyObject *function)
{
    PyObject *found = PyObject_CallNoArgs(function);
    Py_XDECREF(found);
    return found == NULL ? -1 : 0;
}

/* Take the raised exception, with its traceback. */
static PyObject *
caught(void)
{
    PyObject *type, *value, *traceback;
    PyErr_Fetch(&type, &value, &traceback);
    PyErr_NormalizeException(&type, &value, &traceback);
    if (value != NULL && traceback != NULL)
        PyException_SetTraceback(value, traceback);
    Py_XDECREF(type);
    Py_XDECREF(traceback);
    return value;
}

/* Execute a step: 1 to report it, 0 if `finish` has replied, -1 for an error of the worker's. */
static int
step_env(Loop *loop, PyObject *step, int64_t request)
{
    PyObject *outcome = PyObject_CallNoArgs(step);
    if (outcome == NULL && (outcome = caught()) == NULL)
        return -1;
    if (outcome == Py_None && !words_of(&loop->views[LOOP_OWN])[CAREFUL]) {
        Py_DECREF(outcome);
        return 1;
    }
    PyObject *found = PyObject_CallFunction(loop->finish, "LO", (long long)request, outcome);
    Py_DECREF(outcome);
    Py_XDECREF(found);
    return found == NULL ? -1 : 0;
}

static int
execute_entry(Loop *loop, int64_t request)
{
    int64_t index = ((request >> OP_BITS) & SLOT_MASK) - loop->first_slot;
    if (!words_of(&loop->views[LOOP_OWN])[CAREFUL] && (request & OP_MASK) == STEP && index >= 0 &&
        index < PyList_Size(loop->steps)) {
        PyObject *step = item_of(loop->steps, index);
        if (step == NULL)
            return -1;
        int found = step_env(loop, step, request);
        Py_DECREF(step);
        return found;
    }
    PyObject *outcome = PyObject_CallFunction(loop->execute, "L", (long long)request);
    int found = outcome == NULL ? -1 : PyObject_IsTrue(outcome);
    Py_XDECREF(outcome);
    return found;
}

static int
run_loop(Loop *loop, const int64_t *requests, Py_ssize_t count)
{
    int64_t *own = words_of(&loop->views[LOOP_OWN]);
    int64_t *words = words_of(&loop->views[LOOP_WORDS]);
    int64_t *reports = words_of(&loop->views[LOOP_REPORTS]);
    int64_t *bell = words_of(&loop->views[LOOP_BELL]);
    uint64_t mask = (uint64_t)length(&loop->views[LOOP_REPORTS]) - 1;
    for (Py_ssize_t k = 0; k < count; k++) {
        if (load(words + FRAMES_TO_WORKER) > own[FRAMES_SEEN] && called(loop->receive) < 0)
            return -1;
        put(words + CURRENT_SINCE_NS, now_ns());
        publish(words + CURRENT, requests[k]);
        int report = execute_entry(loop, requests[k]);
        put(words + CURRENT, 0);
        if (report < 0)
            return -1;
        if (!report)
            continue;
        put(&reports[(uint64_t)own[REPORTED] & mask], requests[k]);
        own[REPORTED] = (int64_t)((uint64_t)own[REPORTED] + 1);
        publish(bell + loop->counter, own[REPORTED]);
        if (bell_is_due(&loop->views[LOOP_BELL], own, 0) && called(loop->ring) < 0)
            return -1;
    }
    if (bell_is_due(&loop->views[LOOP_BELL], own, 1) && called(loop->ring) < 0)
        return -1;
    return 0;
}

static PyObject *
serve_views(Loop *loop)
{
    Py_buffer *views = loop->views;
    uint64_t capacity = (uint64_t)length(&views[LOOP_REQUESTS]);
    if (length(&views[LOOP_WORDS]) <= CURRENT_SINCE_NS || length(&views[LOOP_OWN]) <= CAREFUL ||
        loop->counter < LINE || loop->counter >= length(&views[LOOP_BELL]) || capacity < 1 ||
        (capacity & (capacity - 1)) != 0 || (uint64_t)length(&views[LOOP_REPORTS]) != capacity) {
        PyErr_SetString(PyExc_ValueError, "rings or bell of unexpected lengths");
        return NULL;
    }
    int64_t *own = words_of(&views[LOOP_OWN]);
    uint64_t sent = (uint64_t)load(words_of(&views[LOOP_WORDS]) + REQUESTS_SENT);
    uint64_t count = sent - (uint64_t)own[TAKEN];
    if (count == 0)
        return Py_NewRef(Py_False);
    if (count > capacity) {
        PyErr_Format(PyExc_RuntimeError, "%lld requests in a ring for %lld", (long long)count,
                     (long long)capacity);
        return NULL;
    }
    int64_t *requests = PyMem_Malloc((size_t)count * sizeof(int64_t));
    if (requests == NULL)
        return PyErr_NoMemory();
    for (uint64_t k = 0; k < count; k++)
        requests[k] =
            peek(words_of(&views[LOOP_REQUESTS]) + (((uint64_t)own[TAKEN] + k) & (capacity - 1)));
    own[TAKEN] = (int64_t)sent;
    int found = run_loop(loop, requests, (Py_ssize_t)count);
    PyMem_Free(requests);
    if (found < 0)
        return NULL;
    return Py_NewRef(Py_True);
}

PyDoc_STRVAR(serve_doc, "See `exchange.serve`.");

static PyObject *
kernel_serve(PyObject *module, PyObject *args)
{
    (void)module;
    Loop loop = {.counter = 0};
    PyObject *side, *fence_object;
    if (!PyArg_ParseTuple(args, "O!OOOOO!LO:serve", &PyTuple_Type, &side, &loop.execute,
                          &loop.finish, &loop.ring, &loop.receive, &PyList_Type, &loop.steps,
                          &loop.first_slot, &fence_object))
        return NULL;
    if (PyTuple_Size(side) != LOOP_VIEWS + 1) {
        PyErr_SetString(PyExc_TypeError, "expected a WorkerSide");
        return NULL;
    }
    loop.counter = PyLong_AsSsize_t(PyTuple_GetItem(side, LOOP_VIEWS));
    if (loop.counter == -1 && PyErr_Occurred())
        return NULL;
    PyObject *found = NULL;
    for (int k = 0; k < LOOP_VIEWS; k++)
        if (get_words(PyTuple_GetItem(side, k), &loop.views[k], 1, "words of a worker") < 0)
            goto done;
    found = serve_views(&loop);
done:
    release_all(loop.views, LOOP_VIEWS);
    return found;
}

/* ---- RowStep: a step whose result goes into a row --------------------------------------------------- */

enum {
    ROW_REWARD,
    ROW_FLAGS,
    ROW_RETURN,
    ROW_LENGTH,
    ROW_MARK,
    ROW_TIMES,
    ROW_OBSERVATION,
    ROW_VIEWS
};

/* The fields of a `exchange.Row`, which are in this order. */
static const struct {
    const char *kinds, *name;
    Py_ssize_t size, count;
} FIELDS[ROW_OBSERVATION] = {
    {"d", "reward", 8, 1},    {"?", "flags", 1, 4}, {"d", "episode_return", 8, 1},
    {"qlnL", "episode_length", 8, 1}, {"B", "info_mark", 1, 1}, {"qlnL", "times", 8, 2},
};

enum { STEP_ENV, GET_INPUT, WRITE_OBSERVATION, NUMBER, WRITE_INFO, KEEP, NDARRAY, FUNCTIONS };

typedef struct {
    PyObject_HEAD
    Py_buffer views[ROW_VIEWS];
    PyObject *functions[FUNCTIONS];
    int resets_itself;
} RowStep;

/* Copy an array into the row, if it has the row's shape and format. */
static int
copied_into_row(RowStep *self, PyObject *observation)
{
    const Py_buffer *row = &self->views[ROW_OBSERVATION];
    if (row->obj == NULL || (PyObject *)Py_TYPE(observation) != self->functions[NDARRAY])
        return 0;
    Py_buffer view;
    if (PyObject_GetBuffer(observation, &view, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT) < 0) {
        PyErr_Clear();
        return 0;
    }
    int fits = view.len == row->len && view.ndim == row->ndim && view.itemsize == row->itemsize &&
               strcmp(kind_of(&view), kind_of(row)) == 0 &&
               (view.ndim == 0 ||
                memcmp(view.shape, row->shape, (size_t)view.ndim * sizeof(Py_ssize_t)) == 0);
    if (fits)
        memcpy(row->buf, view.buf, (size_t)view.len);
    PyBuffer_Release(&view);
    return fits;
}

static int
write_reward(RowStep *self, PyObject *reward)
{
    double value = PyFloat_AsDouble(reward);
    if (value == -1.0 && PyErr_Occurred()) {
        if (PyErr_ExceptionMatches(PyExc_OverflowError) ||
            PyErr_ExceptionMatches(PyExc_ValueError)) /* As a memoryview says it. */
            PyErr_SetString(PyExc_ValueError, "memoryview: invalid value for format 'd'");
        if (!PyErr_ExceptionMatches(PyExc_TypeError))
            return -1;
        PyErr_Clear();
        PyObject *number =
            PyObject_CallFunction(self->functions[NUMBER], "sO", "reward", reward);
        if (number == NULL)
            return -1;
        value = PyFloat_AsDouble(number);
        Py_DECREF(number);
        if (value == -1.0 && PyErr_Occurred())
            return -1;
    }
    *(double *)self->views[ROW_REWARD].buf = value;
    return 0;
}

/* Write the flags and sums of a row, whose reward is there. */
static int
write_ends(RowStep *self, PyObject *terminated, PyObject *truncated)
{
    uint8_t *flags = self->views[ROW_FLAGS].buf;
    double *sum = self->views[ROW_RETURN].buf;
    int64_t *steps = words_of(&self->views[ROW_LENGTH]);
    int was_over = flags[OVER] != 0;
    flags[IS_RESET] = 0;
    if (was_over && self->resets_itself) {
        *sum = 0.0;
        *steps = 0;
    }
    *sum += *(double *)self->views[ROW_REWARD].buf;
    *steps = (int64_t)((uint64_t)*steps + 1);
    int ended = PyObject_IsTrue(terminated), cut = ended < 0 ? -1 : PyObject_IsTrue(truncated);
    if (cut < 0)
        return -1;
    if (!was_over && !ended && !cut)
        return 0;
    flags[TERMINATED] = (uint8_t)ended;
    flags[TRUNCATED] = (uint8_t)cut;
    if (was_over && !self->resets_itself) {
        *sum = 0.0; /* A step after the end belongs to no episode; see `EpisodeSums`. */
        *steps = 0;
    }
    flags[OVER] = (uint8_t)(ended || cut || !self->resets_itself);
    return 0;
}

static PyObject *
write_info(RowStep *self, PyObject *info)
{
    uint8_t *mark = self->views[ROW_MARK].buf;
    int any = PyObject_IsTrue(info);
    if (any < 0)
        return NULL;
    if (!any) {
        *mark = NO_INFO;
        return Py_NewRef(Py_None);
    }
    PyObject *found = PyObject_CallFunctionObjArgs(self->functions[WRITE_INFO], info, NULL);
    long number = found == NULL ? -1 : PyLong_AsLong(found);
    Py_XDECREF(found);
    if (number == -1 && PyErr_Occurred())
        return NULL;
    *mark = (uint8_t)number;
    if (number != PICKLED)
        return Py_NewRef(Py_None);
    PyObject *kept = Py_BuildValue("{sO}", "info", info);
    PyObject *out_of_band =
        kept == NULL ? NULL : PyObject_CallFunctionObjArgs(self->functions[KEEP], kept, NULL);
    Py_XDECREF(kept);
    return out_of_band;
}

/* The result of a step as a tuple of five; anything else is left to Python, also to refuse it. */
static PyObject *
five(PyObject *result)
{
    if (result == NULL || (PyTuple_CheckExact(result) && PyTuple_Size(result) == 5))
        return result;
    PyObject *exchange = PyImport_ImportModule("rlightning_aio.protocol.exchange");
    PyObject *tuple = exchange ? PyObject_CallMethod(exchange, "unpacked", "(O)", result) : NULL;
    Py_XDECREF(exchange);
    Py_DECREF(result);
    if (tuple != NULL && (!PyTuple_CheckExact(tuple) || PyTuple_Size(tuple) != 5)) {
        Py_DECREF(tuple);
        PyErr_SetString(PyExc_TypeError, "expected a tuple of 5");
        return NULL;
    }
    return tuple;
}

static PyObject *
row_step_call(PyObject *object, PyObject *args, PyObject *kwargs)
{
    RowStep *self = (RowStep *)object;
    if (kwargs != NULL || PyTuple_Size(args) > 0) {
        PyErr_SetString(PyExc_TypeError, "a step takes no arguments");
        return NULL;
    }
    int64_t began = now_ns();
    PyObject *input = PyObject_CallNoArgs(self->functions[GET_INPUT]);
    if (input == NULL)
        return NULL;
    PyObject *result = PyObject_CallFunctionObjArgs(self->functions[STEP_ENV], input, NULL);
    Py_DECREF(input);
    if ((result = five(result)) == NULL)
        return NULL;
    int64_t *times = words_of(&self->views[ROW_TIMES]);
    times[0] = now_ns();
    times[1] = times[0] - began;
    PyObject *outcome = NULL, *observation = PyTuple_GetItem(result, 0);
    if (!copied_into_row(self, observation)) {
        PyObject *written =
            PyObject_CallFunctionObjArgs(self->functions[WRITE_OBSERVATION], observation, NULL);
        if (written == NULL)
            goto done;
        Py_DECREF(written);
    }
    if (write_reward(self, PyTuple_GetItem(result, 1)) == 0 &&
        write_ends(self, PyTuple_GetItem(result, 2), PyTuple_GetItem(result, 3)) == 0)
        outcome = write_info(self, PyTuple_GetItem(result, 4));
done:
    Py_DECREF(result);
    return outcome;
}

static int
row_step_traverse(PyObject *object, visitproc visit, void *arg)
{
    RowStep *self = (RowStep *)object;
    Py_VISIT(Py_TYPE(object));
    for (int k = 0; k < FUNCTIONS; k++)
        Py_VISIT(self->functions[k]);
    return 0;
}

static int
row_step_clear(PyObject *object)
{
    /* The functions stay until the end, for a call that is under way; tuples do likewise. */
    (void)object;
    return 0;
}

static void
row_step_dealloc(PyObject *object)
{
    RowStep *self = (RowStep *)object;
    PyTypeObject *type = Py_TYPE(object);
    PyObject_GC_UnTrack(object);
    for (int k = 0; k < FUNCTIONS; k++)
        Py_CLEAR(self->functions[k]);
    release_all(self->views, ROW_VIEWS);
    freefunc release = (freefunc)PyType_GetSlot(type, Py_tp_free);
    release(object);
    Py_DECREF(type);
}

static int
get_row(RowStep *self, PyObject *row)
{
    if (PyTuple_Size(row) != ROW_VIEWS) {
        PyErr_SetString(PyExc_TypeError, "expected a Row");
        return -1;
    }
    for (int k = 0; k < ROW_OBSERVATION; k++) {
        if (get_vector(PyTuple_GetItem(row, k), &self->views[k], FIELDS[k].kinds, FIELDS[k].size,
                       1, 0, FIELDS[k].name) < 0)
            return -1;
        if (length(&self->views[k]) != FIELDS[k].count) {
            PyErr_Format(PyExc_ValueError, "%s: unexpected length", FIELDS[k].name);
            return -1;
        }
    }
    PyObject *observation = PyTuple_GetItem(row, ROW_OBSERVATION);
    Py_buffer *view = &self->views[ROW_OBSERVATION];
    if (observation != Py_None &&
        PyObject_GetBuffer(observation, view,
                           PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE | PyBUF_FORMAT) < 0) {
        view->obj = NULL;
        return -1;
    }
    return 0;
}

static PyObject *
row_step_new(PyTypeObject *type, PyObject *args, PyObject *kwargs)
{
    PyObject *row, *f[FUNCTIONS];
    int resets_itself;
    if (kwargs != NULL && PyDict_Size(kwargs) > 0) {
        PyErr_SetString(PyExc_TypeError, "row_step takes no keyword arguments");
        return NULL;
    }
    if (!PyArg_ParseTuple(args, "O!OOOOOOp:row_step", &PyTuple_Type, &row, &f[STEP_ENV],
                          &f[GET_INPUT], &f[WRITE_OBSERVATION], &f[NUMBER], &f[WRITE_INFO],
                          &f[KEEP], &resets_itself))
        return NULL;
    State *state = PyType_GetModuleState(type);
    if (state == NULL)
        return NULL;
    f[NDARRAY] = state->ndarray;
    allocfunc allocate = (allocfunc)PyType_GetSlot(type, Py_tp_alloc);
    RowStep *self = (RowStep *)allocate(type, 0); /* Zeroed: no buffer is held yet. */
    if (self == NULL)
        return NULL;
    self->resets_itself = resets_itself;
    for (int k = 0; k < FUNCTIONS; k++) {
        Py_INCREF(f[k]);
        self->functions[k] = f[k];
    }
    if (get_row(self, row) < 0) {
        Py_DECREF(self);
        return NULL;
    }
    return (PyObject *)self;
}

static PyType_Slot row_step_slots[] = {
    {Py_tp_new, row_step_new},           {Py_tp_dealloc, row_step_dealloc},
    {Py_tp_call, row_step_call},         {Py_tp_traverse, row_step_traverse},
    {Py_tp_clear, row_step_clear},       {Py_tp_doc, "See `exchange.row_step`."},
    {0, NULL},
};

static PyType_Spec row_step_spec = {
    .name = "rlightning_aio.protocol._kernel.RowStep",
    .basicsize = sizeof(RowStep),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC | Py_TPFLAGS_IMMUTABLETYPE,
    .slots = row_step_slots,
};

/* ---- the module ----------------------------------------------------------------------------------- */

static PyMethodDef methods[] = {
    {"submit", kernel_submit, METH_VARARGS, submit_doc},
    {"complete", kernel_complete, METH_VARARGS, complete_doc},
    {"gather", kernel_gather, METH_VARARGS, gather_doc},
    {"arm", kernel_arm, METH_VARARGS, arm_doc},
    {"is_due", kernel_is_due, METH_VARARGS, is_due_doc},
    {"serve", kernel_serve, METH_VARARGS, serve_doc},
    {NULL, NULL, 0, NULL},
};

static int
initialise(PyObject *module)
{
    PyObject *numpy = PyImport_ImportModule("numpy");
    if (numpy == NULL)
        return -1;
    State *state = state_of(module);
    state->empty = PyObject_GetAttrString(numpy, "empty");
    state->intp = PyObject_GetAttrString(numpy, "intp");
    state->ndarray = PyObject_GetAttrString(numpy, "ndarray");
    Py_DECREF(numpy);
    if (state->empty == NULL || state->intp == NULL || state->ndarray == NULL)
        return -1;
    PyObject *type = PyType_FromModuleAndSpec(module, &row_step_spec, NULL);
    int found = type == NULL ? -1 : PyModule_AddObjectRef(module, "row_step", type);
    Py_XDECREF(type);
    return found;
}

static int
traverse_state(PyObject *module, visitproc visit, void *arg)
{
    State *state = state_of(module);
    Py_VISIT(state->empty);
    Py_VISIT(state->intp);
    Py_VISIT(state->ndarray);
    return 0;
}

static int
clear_state(PyObject *module)
{
    State *state = state_of(module);
    Py_CLEAR(state->empty);
    Py_CLEAR(state->intp);
    Py_CLEAR(state->ndarray);
    return 0;
}

static void
free_module(void *module)
{
    clear_state(module);
}

static PyModuleDef_Slot slots[] = {
    {Py_mod_exec, initialise},
#ifdef Py_mod_gil
    {Py_mod_gil, Py_MOD_GIL_NOT_USED},
#endif
    {0, NULL},
};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT,
    .m_name = "rlightning_aio.protocol._kernel",
    .m_doc = "The compiled kernel; see `exchange`.",
    .m_size = sizeof(State),
    .m_methods = methods,
    .m_slots = slots,
    .m_traverse = traverse_state,
    .m_clear = clear_state,
    .m_free = free_module,
};

PyMODINIT_FUNC
PyInit__kernel(void)
{
    return PyModuleDef_Init(&definition);
}
