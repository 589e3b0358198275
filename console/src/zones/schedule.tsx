// The times of the week in which a zone is in force, or a mission begins.
import { t } from "../i18n/i18n";
import { Typed } from "../typed";
import { DAYS, type Schedule } from "./draft";

interface Props {
  readonly schedule: Schedule | null;
  readonly onChange: (schedule: Schedule | null) => void;
}

type Times = Schedule["times"];
const WORKDAYS: Times[number] = { days: ["mon", "tue", "wed", "thu", "fri"], begin: "08:00", end: "18:00" };

/** Return times of the week to begin with: workdays from 08:00, by this browser's clock. */
export const newSchedule = (end = WORKDAYS.end): Schedule =>
  ({ time_zone: Intl.DateTimeFormat().resolvedOptions().timeZone, times: [{ ...WORKDAYS, end }] });

export function ScheduleFields({ schedule, onChange }: Props): preact.JSX.Element {
  if (schedule === null) {
    return <button type="button" onClick={() => onChange(newSchedule())}>{t("schedule.add")}</button>;
  }
  const set = (times: Times): void => onChange(times.length === 0 ? null : { ...schedule, times });
  const change = (index: number, to: Partial<Times[number]>): void =>
    set(schedule.times.map((time, i) => (i === index ? { ...time, ...to } : time)));
  return (
    <>
      {schedule.times.map((time, index) => (
        <fieldset class="times" key={index}>
          <legend class="muted">{t("schedule.window", { number: index + 1 })}</legend>
          <div class="days">
            {DAYS.map((day) => (
              <label key={day}>
                <input type="checkbox" checked={time.days.includes(day)} onChange={(event) => {
                  const days = DAYS.filter((other) => (other === day ? event.currentTarget.checked : time.days.includes(other)));
                  // A window on no day would be refused.
                  if (days.length > 0) change(index, { days });
                  else event.currentTarget.checked = true;
                }} />
                {t(`day.${day}`)}
              </label>
            ))}
          </div>
          <div class="fields">
            <label>{t("schedule.begin")}
              <Typed value={time.begin} onTyped={({ value }) => value && change(index, { begin: value })}>
                {(typed) => <input type="time" required {...typed} />}
              </Typed>
            </label>
            <label>{t("schedule.end")}
              <Typed value={time.end} onTyped={({ value }) => value && change(index, { end: value })}>
                {(typed) => <input type="time" required {...typed} />}
              </Typed>
            </label>
            <button type="button" class="low" aria-label={t("schedule.remove", { number: index + 1 })} onClick={() => set(schedule.times.filter((_, i) => i !== index))}>✕</button>
          </div>
        </fieldset>
      ))}
      <div class="fields">
        <label>{t("schedule.zone")}
          <Typed value={schedule.time_zone} onTyped={({ value }) => onChange({ ...schedule, time_zone: value })}>
            {(typed) => <input maxLength={64} spellcheck={false} {...typed} />}
          </Typed>
        </label>
        <button type="button" class="low" disabled={schedule.times.length >= 20} onClick={() => set([...schedule.times, WORKDAYS])}>{t("schedule.another")}</button>
      </div>
    </>
  );
}

/** Return a schedule in one line. */
export function scheduleText(schedule: Schedule): string {
  const windows = schedule.times.map(({ days, begin, end }) => `${days.map((day) => t(`day.${day}`)).join(" ")} ${begin}–${end}`);
  return `${windows.join("; ")} (${schedule.time_zone})`;
}
