"""The compiled loop of one alignment: take in fixes as they arrive, go back for late ones, go on.

Built on the steps of `align._kernels`.
"""

# Types of compiled functions are those of their docstrings; numba infers them.
# pyright: reportMissingParameterType=false, reportUnknownParameterType=false

import math

from numba import njit

from ..sins._kernels import COMPILED
from ._cubature_kernel import cubature_predict, cubature_update
from ._kernels import (
    DUPLICATE,
    ESTIMATED,
    FUSED,
    GATED,
    INITIALIZED,
    LATE,
    PENDING,
    REFUSED,
    STAMPED,
    TAKEN_AT,
    fill_fix_noise,
    fill_noise,
    kinematics,
    predict,
    update,
)
from ._state_kernel import (
    carried_on,
    carry_attitude,
    copy_state,
    covariance,
    greatest_move,
    meaningful,
    start,
)

NOT_STARTED, AIDED, DEAD_RECKONING, STOPPED = range(4)


@njit(**COMPILED)
def align(
    time,
    increments,
    gap_variance,
    q_initial,
    fixes,
    outcome,
    delay_model,
    delay_sd,
    initial,
    initial_sd,
    noise_density,
    vibration_variance,
    gate,
    patience,
    dead_reckoning_after,
    horizon,
    samples,
    gravity_model,
    output_epoch,
    outputs,
    memory,
    cubature=None,
):
    """Run the filter over a record. Returns (started, stayed finite).

    Fixes come in order of arrival. Each is applied at an epoch of the record: at its arrival, or, if
    its stamp is trusted (``delay_model`` STAMPED), at the first epoch not before the stamp. The states of
    the last ``horizon`` epochs are kept; a fix for one of them takes its place among the fixes that
    came before it, and everything since is done again. So the result after the last of a shuffled set of
    fixes is that of the sorted set, to the last bit.

    Parameters (n epochs, k fixes, m outputs)
    ----------
    time (n,), increments (n, 6) : record, as in `sins.mechanization`. gap_variance (n, 6) : see `predict`.
    q_initial (4,) : coarse attitude at epoch 0.
    fixes : `reception.Reception`.
    outcome (k,) : PENDING, or the reason for which a fix must not be used; is filled.
    initial (10,), initial_sd (n,) : biases, delay and lever arm at the start; standard deviations there,
        n = 16, or 19 if the lever arm is estimated.
    noise_density (n,) : power spectral densities of the white noises on the states.
    gate : largest NIS to accept.
    dead_reckoning_after : s without a fix that was taken. patience : fixes refused in a row before starting
        again, the last of them after that time, unless none was taken since the start.
    horizon : epochs. samples : intervals to average the specific force over.
    output_epoch (m,) : epochs at which to write the outputs, increasing.
    outputs : tuple of X (m, 22), variances (m, n), misalignment covariance (m, 3, 3), innovation (k, 6),
        nis (k,), fix time (k,), fix jump (k,), status (m,) and jump (m,), see `estimate.Estimate`; what is
        not reached keeps what it had.
    memory : `_memory.working_memory` of so many fixes and epochs, or more; what it has from another record
        is not looked at.
    cubature : `_cubature_kernel.points_memory`, for a filter by cubature points instead of derivatives;
        the loop is compiled for each of the two, without the other's branches.
    """
    fix_lla, fix_v_n, fix_cov, t_reference, arrival_epoch, reference_epoch, packet, source, sequence = fixes
    X_out, variance_out, misalignment_out, innovation_out, nis_out, fix_time_out = outputs[:6]
    fix_jump_out, status_out, jump_out = outputs[6:]
    n, n_fixes = len(time), len(arrival_epoch)
    stamped, estimated = delay_model == STAMPED, delay_model == ESTIMATED
    X, P, X_kept, P_kept, epoch, applied, seen, newest, before, motion, innovation, work, buffers = memory
    C, f_n, w_b, arm, u = motion
    kept, n_applied = len(X_kept), 0
    rooted = False if cubature is None else cubature[0]
    running, now, arriving, output = False, 0, 0, 0
    for i in range(len(X)):
        X[i] = 0.0
    for i in range(len(P)):
        for j in range(len(P)):
            P[i, j] = 0.0
    for f in range(n_fixes):
        seen[f], newest[f] = False, -1
    t_aided, jump, hopeless = -math.inf, 0.0, False

    for k in range(n):
        # Take in what has arrived, each fix at its place in the order of application.
        back, restart = k, False
        arrived, n_before = arriving, n_applied
        while arriving < n_fixes and arrival_epoch[arriving] <= k:
            f = arriving
            arriving += 1
            if outcome[f] != PENDING:
                continue
            if seen[packet[f]]:
                outcome[f] = DUPLICATE
                continue
            epoch[f] = reference_epoch[f] if stamped else k
            overtaken = not stamped and sequence[f] < newest[source[f]]
            if overtaken or epoch[f] < 0 or epoch[f] < k - horizon:
                outcome[f] = LATE
                continue
            seen[packet[f]] = True
            newest[source[f]] = max(newest[source[f]], sequence[f])
            place = n_applied
            while place > 0:
                g = applied[place - 1]
                if (epoch[g], t_reference[g], packet[g]) <= (epoch[f], t_reference[f], packet[f]):
                    break
                applied[place] = g
                place -= 1
            applied[place] = f
            n_applied += 1
            restart = restart or place == 0
            back = min(back, epoch[f])

        # Go back to the oldest of them, and forward again to the present.
        moves = running and n_applied > n_before
        if moves:
            carried_on(X, P, rooted, time, increments, k, gravity_model, work, before)
        first = n_applied
        while first > 0 and epoch[applied[first - 1]] >= back:
            first -= 1
        if restart:
            f, now = applied[0], back
            carry_attitude(X, time, increments, now, q_initial, fix_lla[f], fix_v_n[f], gravity_model, work)
            start(X, P, fix_lla[f], fix_v_n[f], fix_cov[f], initial, initial_sd, rooted)
            running = True
            copy_state(X, P, X_kept[now % kept], P_kept[now % kept])
        elif running and back < k:
            now = back
            copy_state(X_kept[now % kept], P_kept[now % kept], X, P)
        while running:
            while first < n_applied and epoch[applied[first]] == now:
                f = applied[first]
                starting = first == 0 or X[REFUSED] >= patience
                if starting and first > 0:
                    start(X, P, fix_lla[f], fix_v_n[f], fix_cov[f], initial, initial_sd, rooted)
                kinematics(X, time, increments, now, samples, gravity_model, C, f_n, w_b, arm, u)
                age, limit = time[now] - t_reference[f], math.inf if starting else gate
                if cubature is None:
                    nis, taken = update(
                        X,
                        P,
                        fix_lla[f],
                        fix_v_n[f],
                        fix_cov[f],
                        vibration_variance,
                        age + (X[16] if estimated else 0.0),
                        delay_sd,
                        estimated,
                        C,
                        f_n,
                        w_b,
                        arm,
                        u,
                        limit,
                        innovation,
                        buffers,
                    )
                else:
                    fill_fix_noise(fix_cov[f], vibration_variance, delay_sd, u, buffers[3])
                    nis, taken = cubature_update(
                        X,
                        P,
                        fix_lla[f],
                        fix_v_n[f],
                        buffers[3],
                        age,
                        estimated,
                        time,
                        increments,
                        now,
                        samples,
                        gravity_model,
                        motion,
                        limit,
                        innovation,
                        cubature,
                    )
                if taken:
                    # Nothing but the fix of its start was taken: nothing to set against the others.
                    X[REFUSED], X[TAKEN_AT] = 0.0, -math.inf if starting else time[now]
                elif X[REFUSED] + 1 < patience or time[now] - X[TAKEN_AT] > dead_reckoning_after:
                    X[REFUSED] += 1
                hopeless = hopeless or X[REFUSED] >= patience
                outcome[f] = (INITIALIZED if starting else FUSED) if taken else GATED
                for i in range(6):
                    innovation_out[f, i] = innovation[i]
                nis_out[f] = nis
                fix_time_out[f] = time[now]
                first += 1
            if now == k:
                break
            now += 1
            if cubature is None:
                predict(X, P, time, increments, gap_variance, now, noise_density, gravity_model, work)
            else:
                fill_noise(time, now, noise_density, work[6])
                cubature_predict(
                    X, P, time, increments, gap_variance, now, work[6], gravity_model, work, cubature
                )
            copy_state(X, P, X_kept[now % kept], P_kept[now % kept])
        if not meaningful(X, P):
            return running, False

        # What the user is told of it: now, whatever is done again later.
        moved = greatest_move(X, before) if moves else 0.0
        jump = max(jump, moved)
        for f in range(arrived, arriving):
            taken = outcome[f] == FUSED or outcome[f] == INITIALIZED
            if taken:
                t_aided = time[k]
            if moves and (taken or outcome[f] == GATED):
                fix_jump_out[f] = moved
        if output < len(output_epoch) and output_epoch[output] == k:
            status_out[output] = NOT_STARTED
            if running:
                alone = hopeless or time[k] - t_aided > dead_reckoning_after
                status_out[output] = DEAD_RECKONING if alone else AIDED
                hopeless = X[REFUSED] >= patience
            jump_out[output] = jump
            jump = 0.0
        if running and output < len(output_epoch) and output_epoch[output] == k:
            for i in range(len(X)):
                X_out[output, i] = X[i]
            for i in range(len(P)):
                variance_out[output, i] = covariance(P, rooted, i, i)
            for i in range(3):
                for j in range(3):
                    misalignment_out[output, i, j] = covariance(P, rooted, 6 + i, 6 + j)
        if output < len(output_epoch) and output_epoch[output] == k:
            output += 1
    return running, True
