/* One function, which MuJoCo's threads call for each simulation; see `outputs`.
 *
 * It needs neither Python nor MuJoCo's headers: MuJoCo's functions are given as pointers, and the
 * places of its fields as offsets.
 */

#ifndef Py_GIL_DISABLED
#define Py_LIMITED_API 0x030B0000
#endif
#include <Python.h>

#include <math.h>
#include <stdint.h>
#include <string.h>

typedef void (*Compute)(const void *model, void *data);
typedef void (*GetState)(const void *model, const void *data, double *state, int signature);

/* The same as `_Part` and `AdvancePlan` in outputs.py. */
typedef struct {
    int64_t kind;
    int64_t field;  /* Offset of the field's pointer in mjData. */
    int64_t first;  /* Of the field's values. */
    int64_t count;
    double low;
    double high;
    double *values; /* The first of simulation 0. */
    int64_t row;    /* Values from one simulation to the next. */
    int64_t column; /* Values from one value of a simulation to its next. */
} Part;

typedef struct {
    Compute reset;
    Compute forward;
    Compute step;
    Compute finish; /* After the steps, or NULL. */
    GetState get_state;
    int64_t signature;
    int64_t num_moving;
    int64_t fields[3]; /* qpos, qvel, ctrl. */
    int64_t sizes[3];
    const int64_t *num_steps; /* Of each simulation; 0 for a reset. */
    const double *starts;     /* Positions and velocities after a reset. */
    double *before;
    const void *controls;     /* Of float64, or float32 if `is_single`. */
    void *squares;            /* The sum of the squares of each simulation's controls, likewise. */
    int64_t is_single;
    int64_t warning;          /* Offset of the warnings in mjData. */
    int64_t unstable[3];      /* Their positions. */
    int64_t warned;           /* Set to 1 if a simulation got one of them. */
    int64_t num_parts;
    Part parts[];
} Plan;

/* MuJoCo's mjWarningStat. */
typedef struct {
    int lastinfo;
    int number;
} Warning;

enum { POSITIONS, VELOCITIES, CONTROLS };
enum { COPY, SQUARES, WITHIN, ALSO_WITHIN };

static double *
field_at(const void *data, int64_t offset)
{
    double *values;
    memcpy(&values, (const char *)data + offset, sizeof values);
    return values;
}

static void
put(const Plan *plan, void *data, int which, const double *values)
{
    memcpy(field_at(data, plan->fields[which]), values,
           (size_t)plan->sizes[which] * sizeof *values);
}

/* As NumPy's `clip`. */
static double
clipped(double value, double low, double high)
{
    if (isnan(value))
        return value;
    value = value > low ? value : low;
    return value < high ? value : high;
}

/* A function of its own, so that no compiler fuses a product and a sum into one rounding. */
#define SUM_OF_SQUARES(name, type, value)                                                        \
    static type name##_square(const type *values, int64_t k, double low, double high)            \
    {                                                                                            \
        (void)low, (void)high;                                                                   \
        const type found = value;                                                                \
        return found * found;                                                                    \
    }                                                                                            \
    /* In the order of NumPy's sums. */                                                          \
    static type name(const type *values, int64_t count, double low, double high)                 \
    {                                                                                            \
        type sums[8], sum = 0;                                                                   \
        int64_t k = 0;                                                                           \
        if (count > 128) {                                                                       \
            int64_t half = count / 2 - count / 2 % 8;                                            \
            return name(values, half, low, high)                                                 \
                   + name(values + half, count - half, low, high);                               \
        }                                                                                        \
        if (count >= 8) {                                                                        \
            for (; k < 8; k++)                                                                   \
                sums[k] = name##_square(values, k, low, high);                                   \
            for (; k < count - count % 8; k++) {                                                 \
                const type square = name##_square(values, k, low, high);                         \
                sums[k % 8] += square;                                                           \
            }                                                                                    \
            sum = ((sums[0] + sums[1]) + (sums[2] + sums[3]))                                    \
                  + ((sums[4] + sums[5]) + (sums[6] + sums[7]));                                 \
        }                                                                                        \
        for (; k < count; k++) {                                                                 \
            const type square = name##_square(values, k, low, high);                             \
            sum += square;                                                                       \
        }                                                                                        \
        return sum;                                                                              \
    }

SUM_OF_SQUARES(sum_of_doubles, double, clipped(values[k], low, high))
SUM_OF_SQUARES(sum_of_floats, float, values[k])

static int
is_within(const double *values, int64_t count, double low, double high)
{
    for (int64_t k = 0; k < count; k++)
        if (!(low < values[k] && values[k] < high))
            return 0;
    return 1;
}

static void
copy_part(const Part *part, const void *data, int simulation)
{
    const double low = part->low, high = part->high;
    const double *from = field_at(data, part->field) + part->first;
    double *to = part->values + simulation * part->row;
    if (part->kind == SQUARES)
        *to = sum_of_doubles(from, part->count, low, high);
    else if (part->kind == WITHIN)
        *to = is_within(from, part->count, low, high);
    else if (part->kind == ALSO_WITHIN)
        *to = *to != 0.0 && is_within(from, part->count, low, high);
    else if (part->column == 1 && isinf(low) && isinf(high))
        memcpy(to, from, (size_t)part->count * sizeof *to);
    else
        for (int64_t k = 0; k < part->count; k++)
            to[k * part->column] = clipped(from[k], low, high);
}

static void
take_controls(const Plan *plan, void *data, int simulation)
{
    const int64_t size = plan->sizes[CONTROLS];
    double *to = field_at(data, plan->fields[CONTROLS]);
    if (plan->is_single) {
        const float *from = (const float *)plan->controls + simulation * size;
        for (int64_t k = 0; k < size; k++)
            to[k] = from[k];
        ((float *)plan->squares)[simulation] = sum_of_floats(from, size, 0.0, 0.0);
    }
    else {
        const double *from = (const double *)plan->controls + simulation * size;
        memcpy(to, from, (size_t)size * sizeof *to);
        ((double *)plan->squares)[simulation] =
            sum_of_doubles(from, size, -HUGE_VAL, HUGE_VAL);
    }
}

static int64_t
num_warnings(const Plan *plan, const void *data)
{
    int64_t found = 0;
    for (int k = 0; k < 3; k++) {
        Warning warning;
        memcpy(&warning,
               (const char *)data + plan->warning + plan->unstable[k] * (int64_t)sizeof warning,
               sizeof warning);
        found += warning.number;
    }
    return found;
}

/* An mjfBatchFunc. */
static void
advance(const void *model, void *data, int simulation, void *argument)
{
    Plan *plan = argument;
    int64_t num_steps = plan->num_steps[simulation];
    double *before = plan->before + simulation * plan->num_moving;
    if (num_steps == 0) {
        const int64_t *sizes = plan->sizes;
        const double *start =
            plan->starts + simulation * (sizes[POSITIONS] + sizes[VELOCITIES]);
        plan->reset(model, data);
        put(plan, data, POSITIONS, start);
        put(plan, data, VELOCITIES, start + sizes[POSITIONS]);
        plan->forward(model, data);
        plan->get_state(model, data, before, (int)plan->signature);
    }
    else {
        int64_t warnings = num_warnings(plan, data);
        take_controls(plan, data, simulation);
        plan->get_state(model, data, before, (int)plan->signature);
        for (int64_t k = 0; k < num_steps; k++)
            plan->step(model, data);
        if (plan->finish != NULL)
            plan->finish(model, data);
        if (num_warnings(plan, data) != warnings)
            __atomic_store_n(&plan->warned, 1, __ATOMIC_RELAXED);
    }
    for (int64_t k = 0; k < plan->num_parts; k++)
        copy_part(&plan->parts[k], data, simulation);
}

static int
add_address(PyObject *module)
{
    PyObject *address = PyLong_FromVoidPtr((void *)(uintptr_t)advance);
    int failed = PyModule_AddObjectRef(module, "ADVANCE", address);
    Py_XDECREF(address);
    return failed;
}

static PyModuleDef_Slot slots[] = {
    {Py_mod_exec, add_address},
#ifdef Py_mod_gil
    {Py_mod_gil, Py_MOD_GIL_NOT_USED},
#endif
    {0, NULL},
};

static struct PyModuleDef module = {
    PyModuleDef_HEAD_INIT,
    .m_name = "rlightning_aio.envs.mujoco._advance",
    .m_doc = "ADVANCE: the address of a function for `mjb_apply`.",
    .m_slots = slots,
};

PyMODINIT_FUNC
PyInit__advance(void)
{
    return PyModuleDef_Init(&module);
}
