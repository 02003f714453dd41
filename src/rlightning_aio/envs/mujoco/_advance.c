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
    const double *controls;
    double *before;
    int64_t num_parts;
    Part parts[];
} Plan;

enum { POSITIONS, VELOCITIES, CONTROLS };

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

static void
copy_part(const Part *part, const void *data, int simulation)
{
    const double *from = field_at(data, part->field) + part->first;
    double *to = part->values + simulation * part->row;
    if (part->column == 1 && isinf(part->low) && isinf(part->high)) {
        memcpy(to, from, (size_t)part->count * sizeof *to);
        return;
    }
    for (int64_t k = 0; k < part->count; k++)
        to[k * part->column] = clipped(from[k], part->low, part->high);
}

/* An mjfBatchFunc. */
static void
advance(const void *model, void *data, int simulation, void *argument)
{
    const Plan *plan = argument;
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
        put(plan, data, CONTROLS, plan->controls + simulation * plan->sizes[CONTROLS]);
        plan->get_state(model, data, before, (int)plan->signature);
        for (int64_t k = 0; k < num_steps; k++)
            plan->step(model, data);
        if (plan->finish != NULL)
            plan->finish(model, data);
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
